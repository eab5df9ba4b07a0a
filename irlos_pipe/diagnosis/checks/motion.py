"""Whether the image moves from frame to frame by more than photon noise makes it seem to move."""

from __future__ import annotations

import numpy as np
import torch

from irlos_pipe.diagnosis.cube import Stack, Stacks
from irlos_pipe.diagnosis.fitted import Fitted
from irlos_pipe.estimate.image_fit import ImageFit

MOVING = 1.5  # variance ratio from which frames move


def motion_ratio(stack: Stacks, fitted: Fitted) -> float:
    """Variance of tip and tilt between successive frames over that of photon noise.

    Well above 1 for motion, whether or not most of it averages out within a frame; 1 for a detector
    that blurs. Of several recordings, which `stack` and `fitted` hold, it is the mean. NaN where frames
    are too few to show it.
    """
    if not stack.in_time:
        return float("nan")
    problem = fitted.problem
    pairs = enumerate(zip(stack.parts, problem.parts, strict=True))
    return float(np.mean([_ratio(one, part, problem.part(fitted.x, n)) for n, (one, part) in pairs]))


def _ratio(stack: Stack, part: ImageFit, x: torch.Tensor) -> float:
    """The ratio of one recording."""
    frames = stack.frames
    columns = part.predict_and_jacobian(x)[1][0, [0, 1, -2, -1]].cpu().double().mT
    variance = frames.noise.variance_e2(stack.mean_e)
    root = torch.where(frames.good.flatten(), variance**-0.5, 0.0)
    whitened = columns * root[:, None]
    covariance = torch.linalg.inv(whitened.mT @ whitened)
    images = frames.images_e.double().flatten(1) * root
    values = (images @ whitened @ covariance)[:, :2].numpy()
    steps = np.diff(values, axis=0)
    return float(np.mean(steps.var(0) / (2 * np.diag(covariance.numpy())[:2])))
