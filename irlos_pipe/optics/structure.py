"""Structure function of the AO residual from its power spectral density.

``D(b) = 2 ∫∫ PSD(f) [1 - cos(2π f·b)] d²f``, evaluated on a polar grid of spatial
frequencies. The quadrature is a fixed matrix, so `D` is linear in the PSD samples and
its derivatives with respect to any PSD parameter cost one matrix product each.

Outside the correction band the PSD is von Kármán's with the seeing's r0; inside it is
a power law with free variance and slope, and with a two-fold and a four-fold anisotropy: servo lag
stretches the residual along the wind as cos²θ, of whose logarithm these are the first two harmonics,
and the square grid of the actuators has four directions of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import j0

SPARE_NODES, SPARE_ANGLES = 8, 8  # beyond what the fringes of the longest baseline need
VON_KARMAN = 0.0229  # rad² m^(-11/3) r0^(-5/3), e.g. Roddier 1981


@dataclass(frozen=True)
class ResidualBand:
    """Where the AO corrects.

    Attributes
    ----------
    low_per_m, cutoff_per_m : float
        Lowest spatial frequency of the residual (piston, tip and tilt removed) and the
        cut-off 1/(2 actuator pitch) [1/m].
    outer_scale_m : float
        L0 of the uncorrected turbulence [m].
    """

    low_per_m: float
    cutoff_per_m: float
    outer_scale_m: float = 25.0


def seeing_to_r0_m(seeing_arcsec: float, wavelength_nm: float = 500.0) -> float:
    """Fried parameter of a seeing given at `wavelength_nm`: r0 = 0.976 λ / seeing."""
    return 0.976 * wavelength_nm * 1e-9 / np.deg2rad(seeing_arcsec / 3600)


def von_karman_nm2(
    f_per_m: np.ndarray, r0_m: float, outer_scale_m: float, wavelength_nm: float = 500.0
) -> np.ndarray:
    """Von Kármán OPD power spectral density [nm² m²] for r0 given at `wavelength_nm`."""
    radians = VON_KARMAN * r0_m ** (-5 / 3) * (f_per_m**2 + outer_scale_m**-2) ** (-11 / 6)
    return radians * (wavelength_nm / (2 * np.pi)) ** 2


def fitting_variance_nm2(band: ResidualBand, r0_m: float) -> float:
    """Variance of the turbulence beyond the cut-off [nm²]."""
    f, weight = _log_grid(band.cutoff_per_m, 1e3 * band.cutoff_per_m, 400)
    return float(np.sum(2 * np.pi * f * weight * von_karman_nm2(f, r0_m, band.outer_scale_m)))


def fitting_structure_nm2(baselines_m: np.ndarray, band: ResidualBand, r0_m: float) -> np.ndarray:
    """Isotropic structure function of the uncorrected high orders [nm²] at |b| = `baselines_m`."""
    f, weight = _log_grid(band.cutoff_per_m, 300 * band.cutoff_per_m, 1500)
    power = 2 * np.pi * f * weight * von_karman_nm2(f, r0_m, band.outer_scale_m)
    lengths, inverse = np.unique(np.round(baselines_m.ravel(), 9), return_inverse=True)
    # The oscillating integrand is resolved up to the pupil's diameter; beyond, J0 averages out.
    values = np.array([2 * np.sum(power * (1 - j0(2 * np.pi * f * b))) for b in lengths])
    return values[inverse].reshape(baselines_m.shape)


class InBandResidual:
    """In-band structure function ``D = matrix @ exp(log PSD)`` on fixed baselines.

    Parameters
    ----------
    bx_m, by_m : ndarray, any common shape
        Baselines [m].
    band : ResidualBand
    """

    def __init__(self, bx_m: np.ndarray, by_m: np.ndarray, band: ResidualBand):
        ff, aa, area = _polar_grid(band, max(np.abs(bx_m).max(), np.abs(by_m).max()))
        phase = (
            2 * np.pi * (np.outer(bx_m.ravel(), ff * np.cos(aa)) + np.outer(by_m.ravel(), ff * np.sin(aa)))
        )
        self.shape = bx_m.shape
        self.matrix = torch.as_tensor(2 * (1 - np.cos(phase)) * area)
        self.area = torch.as_tensor(area)
        harmonics = (np.cos(2 * aa), np.sin(2 * aa), np.cos(4 * aa), np.sin(4 * aa))
        self.shapes = torch.as_tensor(np.array([-np.log(ff), *harmonics]))

    def structure_nm2(
        self, variance_nm2, slope, stretch_cos=0.0, stretch_sin=0.0, cross_cos=0.0, cross_sin=0.0
    ) -> torch.Tensor:
        """Structure function [nm²], shape of the baselines; differentiable in every argument.

        Parameters
        ----------
        variance_nm2 : tensor or float
            Variance of the in-band residual [nm²]; D is linear in it.
        slope : tensor or float
            PSD ∝ f^(-slope).
        stretch_cos, stretch_sin : tensor or float
            PSD ∝ exp(stretch_cos cos 2θ + stretch_sin sin 2θ).
        cross_cos, cross_sin : tensor or float
            The same with cos 4θ and sin 4θ.
        """
        harmonics = (stretch_cos, stretch_sin, cross_cos, cross_sin)
        psd = self._psd_nm2m2(variance_nm2, slope, harmonics)
        return (self.matrix @ psd).reshape(self.shape)

    def structure_and_slopes(
        self, variance_nm2, slope, stretch_cos=0.0, stretch_sin=0.0, cross_cos=0.0, cross_sin=0.0
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The same with its derivatives, arguments first.

        Automatic differentiation would read the quadrature matrix several times.
        """
        harmonics = (stretch_cos, stretch_sin, cross_cos, cross_sin)
        unit = self._psd_nm2m2(1.0, slope, harmonics)
        centred = self.shapes - (self.shapes @ (self.area * unit))[:, None]
        columns = torch.cat([unit[None], variance_nm2 * unit * centred])
        along_variance, *others = (columns @ self.matrix.mT).reshape(-1, *self.shape)
        return variance_nm2 * along_variance, torch.stack([along_variance, *others])

    def _psd_nm2m2(self, variance_nm2, slope, harmonics) -> torch.Tensor:
        """PSD at the nodes of the quadrature, (nodes,)."""
        pairs = zip((slope, *harmonics), self.shapes, strict=True)
        shape = torch.exp(sum(factor * logarithm for factor, logarithm in pairs))
        return variance_nm2 * shape / torch.sum(self.area * shape)


def _log_grid(low: float, high: float, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Mid-points and widths of `points` logarithmic bins between `low` and `high`."""
    edges = np.geomspace(low, high, points + 1)
    return np.sqrt(edges[1:] * edges[:-1]), np.diff(edges)


def _polar_grid(band: ResidualBand, longest_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequency, angle and area of the quadrature points in the band, over half a turn: the PSD is even.

    Gauss–Legendre in √f, and equal angles, for which the sum over a period converges
    exponentially; both as many as the fringes ``cos(2π f·b)`` of baselines up to `longest_m` need.
    """
    cycles = longest_m * (band.cutoff_per_m - band.low_per_m)
    nodes, weights = np.polynomial.legendre.leggauss(SPARE_NODES + int(np.ceil(2 * cycles)))
    low, high = np.sqrt([band.low_per_m, band.cutoff_per_m])
    root = (low + high + (high - low) * nodes) / 2
    f, width = root**2, root * (high - low) * weights
    angles = np.ceil(np.pi * f * longest_m).astype(int) + SPARE_ANGLES
    angle = np.concatenate([(np.arange(count) + 0.5) * np.pi / count for count in angles])
    return np.repeat(f, angles), angle, np.repeat(2 * f * width * np.pi / angles, angles)
