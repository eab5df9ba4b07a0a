"""AO residual by spatial frequency: its band, and the turbulence beyond it.

Beyond the correction band the power spectral density is von Kármán's with the seeing's r0; what is left
inside the band is in `in_band_residual`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

VON_KARMAN = 0.0229  # rad² m^(-11/3) r0^(-5/3), e.g. Roddier 1981


@dataclass(frozen=True)
class ResidualBand:
    """Where the AO corrects."""

    # low_per_m, cutoff_per_m: one over the diameter of the pupil that has neither tip nor tilt, and the
    # cut-off 1/(2 actuator pitch) [1/m]
    low_per_m: float
    cutoff_per_m: float
    outer_scale_m: float  # L0 of the uncorrected turbulence [m]


def seeing_to_r0_m(seeing_arcsec: float, wavelength_nm: float = 500.0) -> float:
    """Return the Fried parameter of `seeing_arcsec` given at `wavelength_nm`: r0 = 0.976 λ / seeing."""
    return 0.976 * wavelength_nm * 1e-9 / np.deg2rad(seeing_arcsec / 3600)


def von_karman_nm2(
    f_per_m: np.ndarray, r0_m: float, outer_scale_m: float, wavelength_nm: float = 500.0
) -> np.ndarray:
    """Return the Von Kármán power spectral density of the OPD [nm² m²] at spatial frequencies `f_per_m`.

    The Fried parameter `r0_m` is that at `wavelength_nm`.
    """
    radians = VON_KARMAN * r0_m ** (-5 / 3) * (f_per_m**2 + outer_scale_m**-2) ** (-11 / 6)
    return radians * (wavelength_nm / (2 * np.pi)) ** 2


def fitting_variance_nm2(band: ResidualBand, r0_m: float) -> float:
    """Variance of the turbulence beyond the cut-off of a `band` [nm²], for the Fried parameter `r0_m`."""
    f, weight = _log_grid(band.cutoff_per_m, 1e3 * band.cutoff_per_m, 400)
    return float(np.sum(2 * np.pi * f * weight * von_karman_nm2(f, r0_m, band.outer_scale_m)))


def fitting_structure_nm2(baselines_m: np.ndarray, band: ResidualBand, r0_m: float) -> np.ndarray:
    """Isotropic structure function of the orders beyond a `band` [nm²] at |b| = `baselines_m`, for `r0_m`."""
    f, weight = _log_grid(band.cutoff_per_m, 300 * band.cutoff_per_m, 1500)
    power = 2 * np.pi * f * weight * von_karman_nm2(f, r0_m, band.outer_scale_m)
    lengths, inverse = np.unique(np.round(baselines_m.ravel(), 9), return_inverse=True)
    # The oscillating integrand is resolved up to the pupil's diameter; beyond, J0 averages out.
    values = np.array([2 * np.sum(power * (1 - scipy.special.j0(2 * np.pi * f * b))) for b in lengths])
    return values[inverse].reshape(baselines_m.shape)


def _log_grid(low: float, high: float, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Mid-points and widths of `points` logarithmic bins between `low` and `high`."""
    edges = np.geomspace(low, high, points + 1)
    return np.sqrt(edges[1:] * edges[:-1]), np.diff(edges)
