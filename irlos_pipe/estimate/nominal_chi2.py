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

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.estimate.cube import Frames, mean_variance_e2
from irlos_pipe.frames.blocks import blocks

LEAST_FRAMES = 4  # whose scatter is looked at
BY_CHANCE = 5.0  # standard deviations that χ²/ν may differ from its nominal value
NUMERICAL = 0.15  # part of it: complete models leave up to 1.14, by errors of the discretisation
SHARED = 0.15  # part of it: the noise of the dark is read off the frames, to a fifth of their scatter
LONGEST = 512  # frames of which all pairs are looked at; of more, runs of neighbours are averaged


@dataclass(frozen=True)
class NominalChi2:
    """Expected χ²/ν of a model that lacks nothing, and its standard deviation from cube to cube."""

    value: float
    sigma: float

    @property
    def least(self) -> float:
        """Below this χ²/ν is neither by chance nor by the error of the noise that all frames share."""
        return max(0.0, (1 - SHARED) * self.value - BY_CHANCE * self.sigma)

    @property
    def most(self) -> float:
        """Above this χ²/ν is neither by chance nor by errors of the discretisation."""
        return (1 + NUMERICAL) * self.value + BY_CHANCE * self.sigma


@dataclass(frozen=True)
class Part:
    """A mean image among those that are fitted together.

    Attributes
    ----------
    frames : Frames
        Of fewer than `LEAST_FRAMES` the noise model takes the place of the scatter.
    jacobian : tensor, (its parameters, pixels)
        Derivatives of the model image [e- per unit of the parameter].
    columns : sequence of int, (its parameters,)
        Where they stand among the parameters of all parts.
    """

    frames: Frames
    jacobian: torch.Tensor
    columns: Sequence[int]


def nominal_chi2(frames: Frames, jacobian: torch.Tensor, precision: torch.Tensor) -> NominalChi2:
    """Return the χ²/ν that the mean of `frames` would have about a model that lacks nothing.

    Parameters
    ----------
    frames, jacobian
        See `Part`.
    precision : tensor, (parameters,)
        Of the prior, 0 where there is none.
    """
    return nominal_chi2_of([Part(frames, jacobian, range(len(precision)))], precision)


def nominal_chi2_of(parts: Sequence[Part], precision: torch.Tensor) -> NominalChi2:
    """Return the χ²/ν of mean images fitted together about a model that lacks nothing.

    Parameters
    ----------
    parts : sequence of Part
    precision : tensor, (parameters of all,)
        Of the prior, 0 where there is none.
    """
    whitened = [_Whitened.of(part) for part in parts]
    data = torch.zeros(len(precision), len(precision), dtype=torch.float64)
    for one in whitened:
        data[one.place[:, None], one.place] += one.columns.mT @ one.columns
    gain = torch.linalg.pinv(data + torch.diag(precision.double()), hermitian=True)
    used = sum(one.used for one in whitened)
    freedom = max(used - len(precision), 1)
    followed = gain @ data
    white = used - 2 * float(torch.trace(followed)) + float((followed * followed.mT).sum())
    expected, variance = 0.0, 0.0
    for part, one in zip(parts, whitened, strict=True):
        share = white * one.used / used
        if len(part.frames.images_e) < LEAST_FRAMES:
            expected, variance = expected + share, variance + 2 * share
            continue
        own, deviation = _of_scatter(one.products(part.frames, gain, data))
        shared = float((part.frames.noise.shared_e2 * one.root**2).sum()) * share / one.used
        expected, variance = expected + own + shared, variance + deviation**2
    return NominalChi2(expected / freedom, float(np.sqrt(variance)) / freedom)


@dataclass(frozen=True)
class _Whitened:
    """Derivatives of a mean image in units of its noise: (pixels, its parameters), and where these stand."""

    root: torch.Tensor
    columns: torch.Tensor
    place: torch.Tensor

    @classmethod
    def of(cls, part: Part) -> _Whitened:
        variance = mean_variance_e2(part.frames).flatten()
        usable = part.frames.good.flatten() & torch.isfinite(variance)
        root = torch.where(usable, variance**-0.5, 0.0)
        return cls(root, (part.jacobian.double().cpu() * root).mT, torch.tensor(list(part.columns)))

    @property
    def used(self) -> int:
        return int((self.root > 0).sum())

    def products(self, frames: Frames, gain: torch.Tensor, data: torch.Tensor) -> torch.Tensor:
        """Products of what deviations of the frames leave in all images, (frames, frames).

        Whitened deviations d less what the parameters of all images follow: ``R d · R d'``.
        """
        images, mean = frames.images_e.flatten(1), frames.mean_e.flatten()
        runs = torch.arange(len(images)).tensor_split(min(len(images), LONGEST))
        whitened = torch.empty(len(runs), len(self.root), dtype=torch.float64)
        for block in blocks(len(runs)):
            some = torch.stack([images[run].mean(0, dtype=torch.float64) for run in runs[block]])
            whitened[block] = torch.where(self.root > 0, (some - mean) * self.root, 0.0)
        felt = whitened @ self.columns
        moved = felt @ gain[self.place]
        return whitened @ whitened.mT - 2 * moved[:, self.place] @ felt.mT + moved @ data @ moved.mT


def _of_scatter(products: torch.Tensor) -> tuple[float, float]:
    """Expected χ² of the mean of frames with these products, and its standard deviation."""
    count = len(products)
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
