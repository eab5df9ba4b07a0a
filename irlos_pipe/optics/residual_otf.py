"""OTF of the AO residual: its mean over the pupil, and the motion that goes with coma."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from irlos_pipe.conventions.late import torch
from irlos_pipe.conventions.units import NM
from irlos_pipe.optics.fourier_matrices import FocalGrid
from irlos_pipe.optics.grids import OtfGrid
from irlos_pipe.optics.structure_function import (
    InBandResidual,
    Residual,
    ResidualBand,
    fitting_structure_nm2,
)

NODES = 16  # per axis: the squared differences are polynomials of degree 4 in both

COMA = 7, 8  # Noll, along y and along x


def coma_between(lengths_m: np.ndarray, diameter_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return moments of ``ψ(x + b) - ψ(x)`` over a clear circle, by the lengths of the baselines, (n,).

    They are over the points x for which x + b is inside, too. ψ is Noll 8 for a baseline b along x; turned,
    the moments hold for every baseline. Baselines beyond the diameter are taken for it.

    Returns the mean of the coma along the baseline, that of the coma across it being 0, and the variances of
    both, along first, (n,) each.
    """
    lengths, inverse = np.unique(np.round(lengths_m, 9), return_inverse=True)
    b = np.minimum(2 * lengths / diameter_m, 2 - 1e-9)[:, None, None]
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    angle = np.pi / 2 * nodes[:, None]
    y = np.sqrt(1 - b**2 / 4) * np.sin(angle)
    reach = np.sqrt(1 - y**2) - b / 2  # either way from the middle of the two points
    middle = reach * nodes
    weight = np.cos(angle) * weights[:, None] * reach * weights
    along, across = _coma(middle + b / 2, y) - _coma(middle - b / 2, y)
    weight = weight / weight.sum((1, 2), keepdims=True)
    mean = np.sum(weight * along, (1, 2))
    variances = np.sum(weight * along**2, (1, 2)) - mean**2, np.sum(weight * across**2, (1, 2))
    return mean[inverse], variances[0][inverse], variances[1][inverse]


def _coma(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Noll 8 and 7 on the unit disc, (2, ...)."""
    radial = np.sqrt(8) * (3 * (x**2 + y**2) - 2)
    return np.stack([radial * x, radial * y])


class MeanFactor(NamedTuple):
    """OTF factor of the residual with the mean motion that goes with coma, or a derivative of it."""

    log: torch.Tensor  # (wavelengths, p, p//2 + 1): logarithm of the factor: ``m + v/2 - ½ (2π/λ)² D``
    mean: torch.Tensor  # (wavelengths, p, p//2 + 1): the m in it


class ResidualOtf:
    """The residual in a `band`, on the baselines of a `focal` grid, of a Fried parameter `r0_m`.

    Its parameters are the arguments of `InBandResidual.at`, and in addition how much turbulence is beyond the
    cut-off, as a share of what the Fried parameter gives.
    """

    def __init__(self, band: ResidualBand, r0_m: float, focal: FocalGrid):
        bx, by = np.broadcast_arrays(focal.baseline_x_m[None, :], focal.baseline_y_m[:, None])
        lengths = np.hypot(bx, by)
        within = lengths <= focal.longest_m
        self._fitting_nm2 = torch.as_tensor(fitting_structure_nm2(lengths[within], band, r0_m))
        # Place of every baseline of the grid among those within the pupil.
        self._place = torch.as_tensor(np.where(within, np.cumsum(within).reshape(within.shape) - 1, 0))
        bx, by = bx[within], by[within]
        self._in_band = InBandResidual(bx, by, band)
        self._coma = [torch.as_tensor(one) for one in coma_between(lengths[within], 1 / band.low_per_m)]
        b = np.maximum(lengths[within], 1e-9)
        self._along = torch.as_tensor(np.stack([bx * bx, 2 * bx * by, by * by]) / b)
        self._across = torch.as_tensor(np.stack([-bx * by, bx * bx - by * by, bx * by]) / b)
        # Star and modes request the same one in succession.
        self._at = lru_cache(maxsize=1)(lambda *values: self._in_band.at(*_tensor(values)))
        self._slopes_at = lru_cache(maxsize=1)(lambda *values: self._in_band.with_slopes(_tensor(values)))

    def structure_nm2(self, values: torch.Tensor, beyond) -> torch.Tensor:
        """Return the structure function D, (p, p//2 + 1) [nm²].

        The `values`, (7,), are the arguments of `InBandResidual.at`; `beyond` is the share of the turbulence
        beyond the cut-off.
        """
        return (self._residual(values).structure + beyond * self._fitting_nm2)[self._place]

    def exponent(self, values: torch.Tensor, beyond, grid: OtfGrid) -> torch.Tensor:
        """Return ``½ (2π/λ)² D`` at the wavelengths of a `grid`, (wavelengths, p, p//2 + 1).

        `values` and `beyond` are as of `structure_nm2`; the baselines are those of the object.
        """
        return 0.5 * per_nm2(grid) * self.structure_nm2(values, beyond)

    def mean_factor(self, values: torch.Tensor, beyond, grid: OtfGrid) -> MeanFactor:
        """Return the mean of the OTF factor over the pupil, for a flat wavefront.

        `values`, `beyond` and `grid` are as of `exponent`.
        """
        mean, along, across = self._coma
        lengthwise, crosswise = self._ways(self._residual(values).tilt_with_coma)
        variance = along * lengthwise**2 + across * crosswise**2
        log, mean = self._of_moments(mean * lengthwise, variance, grid)
        return MeanFactor(log - self.exponent(values, beyond, grid), mean)

    def rates(self, values: torch.Tensor, by_beyond: Mapping[int, float], grid: OtfGrid) -> list[MeanFactor]:
        """Return derivatives of `mean_factor`; `values` and `grid` are as of `exponent`.

        The derivatives of the share of the turbulence beyond the cut-off are `by_beyond`, by the parameters
        that are requested.
        """
        residual, slopes = self._with_slopes(values)
        mean, along, across = self._coma
        lengthwise, crosswise = self._ways(residual.tilt_with_coma)
        found = []
        for index, share in by_beyond.items():
            longer, wider = self._ways(slopes.tilt_with_coma[index])
            variance = 2 * (along * lengthwise * longer + across * crosswise * wider)
            log, shift = self._of_moments(mean * longer, variance, grid)
            structure = (slopes.structure[index] + share * self._fitting_nm2)[self._place]
            found.append(MeanFactor(log - 0.5 * per_nm2(grid) * structure, shift))
        return found

    def moving(self, values: torch.Tensor, noll: int, grid: OtfGrid) -> torch.Tensor:
        """Return ``i (2π/λ) b·<a c>``, phase per coma that goes with it, (wavelengths, p, p//2 + 1) [1/nm].

        The coma c is `noll`, see `COMA`; `values` and `grid` are as of `exponent`.
        """
        return _moving(self._residual(values).tilt_with_coma, noll, grid)

    def moving_rates(self, values: torch.Tensor, noll: int, grid: OtfGrid) -> list[torch.Tensor]:
        """Return the derivatives of `moving`, with the same `values`, `noll` and `grid`."""
        return [_moving(one, noll, grid) for one in self._with_slopes(values)[1].tilt_with_coma]

    def _ways(self, with_coma: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """``b·<a c>`` for the coma along every baseline and for that across it [nm²]."""
        return with_coma @ self._along, with_coma @ self._across

    def _of_moments(self, mean_nm2: torch.Tensor, variance_nm4: torch.Tensor, grid: OtfGrid) -> MeanFactor:
        """The factor ``exp(m + v/2)``."""
        mean = per_nm2(grid) * mean_nm2[self._place]
        return MeanFactor(mean + per_nm2(grid) ** 2 * variance_nm4[self._place] / 2, mean)

    def _residual(self, values: torch.Tensor) -> Residual:
        return self._in_band.at(*values) if values.requires_grad else self._at(*values.tolist())

    def _with_slopes(self, values: torch.Tensor) -> tuple[Residual, Residual]:
        return self._slopes_at(*values.tolist())


@lru_cache(maxsize=4)
def residual_otf(band: ResidualBand, r0_m: float, focal: FocalGrid) -> ResidualOtf:
    """Return the residual on the baselines of `focal`, made once; `band` and `r0_m` as of `ResidualOtf`."""
    return ResidualOtf(band, r0_m, focal)


def per_nm2(grid: OtfGrid) -> torch.Tensor:
    """``(2π/λ)²`` [rad²/nm²], (wavelengths, 1, 1)."""
    return (2 * np.pi * NM / grid.wavelengths_m) ** 2


def _moving(with_coma: torch.Tensor, noll: int, grid: OtfGrid) -> torch.Tensor:
    """``i (2π/λ) b·<a c>`` for the coma `noll`, whose covariances are with the tilts along x and along y."""
    tilts = {COMA[0]: slice(1, 3), COMA[1]: slice(0, 2)}[noll]
    return 1j * per_nm2(grid).sqrt() * grid.path_m(*with_coma[tilts])


def _tensor(values: Sequence[float]) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)
