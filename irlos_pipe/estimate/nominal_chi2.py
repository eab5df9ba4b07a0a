"""What χ²/ν of a mean image is nominal: that of a model which lacks nothing.

The weights of a mean image count every pixel's scatter by itself. Scatter that pixels share, as that of
speckles, is partly followed by the modes, so that χ²/ν of a right model is 1 for photon noise and less for
speckles, by an amount that depends on brightness, seeing and number of frames. The frames tell it. With the
whitened deviations ``d_i`` of N frames from their mean, and the matrix R that takes the part out which the
fitted parameters would follow,

    E[χ²] = τ Σ |R d_i|² / (N (N − 1)),     Var[χ²] = 2 τ² tr(Σ²) / N²,

where Σ is the covariance of ``R d`` and τ the autocorrelation time of the frames. An unbiased estimate of
tr(Σ²) is the mean of ``(R d_i · R d_j)²`` over pairs (Bai & Saranadasa 1996, Statistica Sinica 6, 311).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.estimate.cube import Frames, mean_variance_e2
from irlos_pipe.frames.blocks import blocks

LEAST_FRAMES = 4  # whose scatter is looked at
LONGEST = 512  # frames of which all pairs are looked at; of more, runs of neighbours are averaged


@dataclass(frozen=True)
class NominalChi2:
    """Expected χ²/ν of a model that lacks nothing, and its standard deviation from cube to cube."""

    value: float
    sigma: float


def nominal_chi2(frames: Frames, jacobian: torch.Tensor, precision: torch.Tensor) -> NominalChi2:
    """Return the χ²/ν that the mean of `frames` would have about a model that lacks nothing.

    Parameters
    ----------
    frames : Frames
        Of fewer than `LEAST_FRAMES` the noise model takes the place of the scatter.
    jacobian : tensor, (parameters, pixels)
        Derivatives of the model image [e- per unit of the parameter].
    precision : tensor, (parameters,)
        Of the prior, 0 where there is none.
    """
    variance = mean_variance_e2(frames).flatten()
    usable = frames.good.flatten() & torch.isfinite(variance)
    root = torch.where(usable, variance**-0.5, 0.0)
    columns = (jacobian.double().cpu() * root).mT
    gain = torch.linalg.pinv(columns.mT @ columns + torch.diag(precision.double()), hermitian=True)
    used = int((root > 0).sum())
    freedom = max(used - len(precision), 1)
    followed = gain @ (columns.mT @ columns)
    white = used - 2 * float(torch.trace(followed)) + float((followed * followed.mT).sum())
    if len(frames.images_e) < LEAST_FRAMES:
        return NominalChi2(white / freedom, float(np.sqrt(2 * white)) / freedom)
    shared = float((frames.noise.shared_e2 * root**2).sum()) * white / used
    expected, deviation = _of_scatter(_left(frames, root, columns, gain))
    return NominalChi2((expected + shared) / freedom, deviation / freedom)


def _left(frames: Frames, root: torch.Tensor, columns: torch.Tensor, gain: torch.Tensor) -> torch.Tensor:
    """Whitened deviations of the frames from their mean without what parameters follow, (frames, pixels)."""
    images, mean = frames.images_e.flatten(1), frames.mean_e.flatten()
    runs = torch.arange(len(images)).tensor_split(min(len(images), LONGEST))
    left = torch.empty(len(runs), len(root), dtype=torch.float64)
    for block in blocks(len(runs)):
        some = torch.stack([images[run].mean(0, dtype=torch.float64) for run in runs[block]])
        whitened = torch.where(root > 0, (some - mean) * root, 0.0)
        left[block] = whitened - (whitened @ columns) @ gain @ columns.mT
    return left


def _of_scatter(left: torch.Tensor) -> tuple[float, float]:
    """Expected χ² of the mean, and its standard deviation."""
    count = len(left)
    products = left @ left.mT
    squares = products.diagonal()
    time = _autocorrelation_time(products)
    expected = time * float(squares.sum()) / (count * (count - 1))
    pairs = float(products.square().sum() - squares.square().sum()) / (count * (count - 1))
    of_one = time / count * float(squares.std()) / np.sqrt(count)
    return expected, float(np.hypot(np.sqrt(2 * pairs) * time / count, of_one))


def _autocorrelation_time(products: torch.Tensor) -> float:
    """Integrated autocorrelation time of vectors from their products, as `cube.autocorrelation_time`."""
    count = len(products)
    if count < 8:
        return 1.0
    total = float(products.diagonal().mean())
    rho = [float(products.diagonal(lag).mean()) / total for lag in range(1, count // 4 * 2 + 1)]
    time = 1.0
    for first, second in zip(rho[::2], rho[1::2], strict=True):
        if first + second <= 0:
            break
        time += 2 * (first + second)
    return time
