"""Structure function of the AO residual from its power spectral density.

``D(b) = 2 ∫∫ PSD(f) [1 - cos(2π f·b)] d²f``, evaluated on rings of spatial frequencies and, around each
ring, by harmonics.

Outside the correction band the PSD is von Kármán's with the seeing's r0; inside it is
a power law with free variance and slope, and with a two-fold and a four-fold anisotropy: servo lag
stretches the residual along the wind as cos²θ, of whose logarithm these are the first two harmonics,
and the square grid of the actuators has four directions of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from irlos_pipe.conventions.late import torch

SPARE_NODES, SPARE_ORDERS = 8, 40  # beyond what the fringes of the longest baseline need
HARMONICS = 24  # of the angular part of the PSD; those beyond are below 1e-6 for any it can have
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
    outer_scale_m: float


def seeing_to_r0_m(seeing_arcsec: float, wavelength_nm: float = 500.0) -> float:
    """Return the Fried parameter of `seeing_arcsec` given at `wavelength_nm`: r0 = 0.976 λ / seeing."""
    return 0.976 * wavelength_nm * 1e-9 / np.deg2rad(seeing_arcsec / 3600)


def von_karman_nm2(
    f_per_m: np.ndarray, r0_m: float, outer_scale_m: float, wavelength_nm: float = 500.0
) -> np.ndarray:
    """Return the Von Kármán power spectral density of the OPD [nm² m²].

    Parameters
    ----------
    f_per_m : ndarray
        Spatial frequencies [1/m].
    r0_m, outer_scale_m : float
        Fried parameter at `wavelength_nm`, and outer scale [m].
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


class InBandResidual:
    """In-band structure function on fixed baselines.

    The PSD is a product ``f^(-slope) g(θ)``, so each harmonic ``a cos 2kθ`` of g gives the baselines of
    one length b a common factor (Jacobi–Anger): ``D = 2σ² (1 - Σ_k a_k cos(2kφ) R_k(b))``, φ being the
    direction of the baseline and R_k the mean of ``(-1)^k J_2k(2πfb)`` over the frequencies.

    Parameters
    ----------
    bx_m, by_m : ndarray, (baselines,)
        Baselines [m].
    band : ResidualBand
    """

    def __init__(self, bx_m: np.ndarray, by_m: np.ndarray, band: ResidualBand):
        lengths, place = np.unique(np.round(np.hypot(bx_m, by_m), 9), return_inverse=True)
        f, area = _radial_grid(band, lengths.max())
        orders = 2 * np.arange(HARMONICS + 1)
        along = np.arctan2(by_m, bx_m)[:, None] * orders
        theta = (np.arange(4 * HARMONICS) + 0.5) * np.pi / (4 * HARMONICS)
        shares = np.where(orders > 0, 2.0, 1.0) / len(theta)
        self._waves = torch.as_tensor(_even_bessel(2 * np.pi * np.outer(lengths, f)))
        self._place = torch.as_tensor(place)
        self._log_area, self._log_f = torch.as_tensor(np.log(area)), torch.as_tensor(np.log(f))
        self._directions = torch.as_tensor(np.stack([np.cos(along), np.sin(along)], axis=1))
        around = theta[:, None] * orders
        self._harmonics = torch.as_tensor(np.hstack([np.cos(around) * shares, np.sin(around) * shares]))
        turns = (np.cos(2 * theta), np.sin(2 * theta), np.cos(4 * theta), np.sin(4 * theta))
        self._turns = torch.as_tensor(np.array(turns))

    def structure_nm2(
        self, variance_nm2, slope, stretch_cos=0.0, stretch_sin=0.0, cross_cos=0.0, cross_sin=0.0
    ) -> torch.Tensor:
        """Return the structure function [nm²], (baselines,); differentiable in every argument.

        Parameters
        ----------
        variance_nm2 : tensor or float
            Variance of the in-band residual [nm²]; D is linear in it.
        slope : tensor or float
            PSD ∝ f^(-slope).
        stretch_cos, stretch_sin : tensor or float
            PSD ∝ exp(stretch_cos cos 2θ + stretch_sin sin 2θ).
        cross_cos, cross_sin : tensor or float
            Anisotropy that goes with cos 4θ and sin 4θ.
        """
        frequencies = self._frequencies(slope)
        directions = self._angles((stretch_cos, stretch_sin, cross_cos, cross_sin))
        return 2 * variance_nm2 * (1 - self._coherence(frequencies, directions[None])[0])

    def structure_and_slopes(
        self, variance_nm2, slope, stretch_cos=0.0, stretch_sin=0.0, cross_cos=0.0, cross_sin=0.0
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See `structure_nm2`; with its derivatives, arguments first."""
        w = self._frequencies(slope)
        g = self._angles((stretch_cos, stretch_sin, cross_cos, cross_sin))
        steeper = w * ((w * self._log_f).sum() - self._log_f)
        turned = g * (self._turns - (self._turns @ g / len(g))[:, None])
        coherence, *by_angles = self._coherence(w, torch.cat([g[None], turned]))
        changes = torch.stack([*self._coherence(steeper, g[None]), *by_angles])
        along_variance = 2 * (1 - coherence)
        return variance_nm2 * along_variance, torch.cat([along_variance[None], -2 * variance_nm2 * changes])

    def _frequencies(self, slope) -> torch.Tensor:
        """Share of each frequency in the variance, (frequencies,)."""
        return torch.softmax(self._log_area - slope * self._log_f, 0)

    def _angles(self, harmonics) -> torch.Tensor:
        """Angular part of the PSD, of mean 1, (angles,)."""
        g = torch.exp(sum(factor * turn for factor, turn in zip(harmonics, self._turns, strict=True)))
        return g / g.mean()

    def _coherence(self, frequencies: torch.Tensor, angles: torch.Tensor) -> torch.Tensor:
        """Mean of ``cos(2π f·b)`` over PSDs with these angular parts (m, angles), (m, baselines)."""
        radial = torch.einsum("lkf,f->lk", self._waves, frequencies).index_select(0, self._place)
        shapes = (self._directions * radial[:, None]).flatten(1)
        return (shapes @ (angles @ self._harmonics).mT).mT


def _log_grid(low: float, high: float, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Mid-points and widths of `points` logarithmic bins between `low` and `high`."""
    edges = np.geomspace(low, high, points + 1)
    return np.sqrt(edges[1:] * edges[:-1]), np.diff(edges)


def _radial_grid(band: ResidualBand, longest_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies and areas of rings in the band, as many as baselines up to `longest_m` need.

    Gauss–Legendre in √f.
    """
    cycles = longest_m * (band.cutoff_per_m - band.low_per_m)
    nodes, weights = np.polynomial.legendre.leggauss(SPARE_NODES + int(np.ceil(2 * cycles)))
    low, high = np.sqrt([band.low_per_m, band.cutoff_per_m])
    root = (low + high + (high - low) * nodes) / 2
    return root**2, 2 * root**2 * root * (high - low) * weights


def _even_bessel(z: np.ndarray) -> np.ndarray:
    """``(-1)^k J_2k(z)`` of z (m, n) for k up to `HARMONICS`, (m, harmonics + 1, n).

    The mean of ``cos(z cos α) cos 2kα`` over a quarter turn (Bessel's integral); over equal angles it is
    exact but for J of an order beyond z.
    """
    points = int(np.ceil((z.max() + 2 * HARMONICS + SPARE_ORDERS) / 4))
    angles = (np.arange(points) + 0.5) * np.pi / 2 / points
    table = np.cos(2 * np.arange(HARMONICS + 1)[:, None] * angles) / points
    return np.ascontiguousarray(np.swapaxes(np.cos(z[..., None] * np.cos(angles)) @ table.T, 1, 2))
