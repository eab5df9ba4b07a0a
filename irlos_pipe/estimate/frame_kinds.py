"""Whether the frames of a cube are of one kind, or a mixture of two: stars, pointings, wavefronts.

A mixture scatters by more than its parts, so that its scatter excuses what a single model misfits. But it
does not scatter as noise does: along the direction in which most of the variance lies, frames of two kinds
sit at two values. Their kurtosis is 1 for halves, 3 for Gaussian scatter and 1.5 for a sinusoidal
vibration. Differences in brightness do not count.
"""

from __future__ import annotations

import numpy as np
import torch

from irlos_pipe.estimate.cube import Frames, mean_variance_e2
from irlos_pipe.frames.blocks import sample_frames

LEAST_FRAMES = (
    20  # Gaussian scatter of 16 has a kurtosis below 1.3 in one of 1000 cubes, of 20 in one of 5000
)
LEADING = 0.3  # part of the variance from which one direction is looked at


def kurtosis_of_frames(frames: Frames) -> float:
    """Return the kurtosis of the frames along the direction in which they differ most.

    Parameters
    ----------
    frames : Frames

    Returns
    -------
    float
        NaN for fewer than `LEAST_FRAMES`, or where no direction leads.
    """
    some = frames.images_e[torch.as_tensor(sample_frames(len(frames.images_e)))].flatten(1).double()
    if len(some) < LEAST_FRAMES:
        return float("nan")
    variance = mean_variance_e2(frames).flatten()
    usable = frames.good.flatten() & torch.isfinite(variance) & torch.isfinite(some).all(0)
    whitened = ((some - some.mean(0)) * variance**-0.5)[:, usable]
    star = (some.mean(0) * variance**-0.5)[usable]
    whitened -= (whitened @ star)[:, None] * (star / (star @ star))  # clouds dim the same star
    values, vectors = np.linalg.eigh((whitened @ whitened.mT).numpy())
    if not values[-1] > LEADING * values.sum():
        return float("nan")
    along = vectors[:, -1] - vectors[:, -1].mean()
    return float(len(along) * np.sum(along**4) / np.sum(along**2) ** 2)
