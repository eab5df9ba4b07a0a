"""Structure function of the AO residual from its power spectral density.

``D(b) = 2 ∫∫ PSD(f) [1 - cos(2π f·b)] d²f``, evaluated on rings of spatial frequencies and, around each
ring, by harmonics.

Outside the correction band the PSD is von Kármán's with the seeing's r0; inside it is the sum of

- a power law with free variance and slope, and with a two-fold and a four-fold anisotropy: servo lag
  stretches the residual along the wind as cos²θ, of whose logarithm these are the first two harmonics,
  and the square grid of the actuators has four directions of its own;
- turbulence that a Shack–Hartmann sensor with that grid takes for low frequencies (Rigaut et al. 1998,
  Proc. SPIE 3353, 1038; Jolissaint 2010, J. Eur. Opt. Soc. 5, 10055), of free variance: unlike a power law
  it is level at low frequencies and rises towards the cut-off.

The residual has no tip and tilt over the pupil: with tilts a_j along x and y [nm/m], it is ``g - a·x``, g
having the same PSD everywhere. Its structure function between x and x + b is

    D(b) - bᵀ<a aᵀ>b - 2 b·[c(x + b) - c(x)]

where c, the covariance of a with g beyond piston, tip and tilt, is coma to within some per cent, since
turbulence of long waves has coma together with tilt. The last term differs from place to place.
Covariances of Zernike coefficients are those over a clear circle (Noll 1976, J. Opt. Soc. Am. 66, 207).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from irlos_pipe.conventions.late import torch

SEEING_NM = 500.0  # wavelength at which seeing and Fried parameters are given
VON_KARMAN = 0.0229  # rad² m^(-11/3) r0^(-5/3), e.g. Roddier 1981
SPARE_NODES, SPARE_ORDERS = 14, 40  # beyond what the fringes of the longest baseline need
HARMONICS = 24  # of the angular part of the PSD; those beyond are below 1e-6 for any it can have
LOWEST = 0.5  # frequency times the pupil's diameter: of longer waves, tip and tilt are 92 % or more
ALIASES = 3  # folded bands on each side


@dataclass(frozen=True)
class ResidualBand:
    """Where the AO corrects."""

    # low_per_m, cutoff_per_m: one over the diameter of the pupil that has neither tip nor tilt, and the
    # cut-off 1/(2 actuator pitch) [1/m]
    low_per_m: float
    cutoff_per_m: float
    outer_scale_m: float  # L0 of the uncorrected turbulence [m]


def seeing_to_r0_m(seeing_arcsec: float) -> float:
    """Return the Fried parameter of `seeing_arcsec`, both at `SEEING_NM`: r0 = 0.976 λ / seeing."""
    return 0.976 * SEEING_NM * 1e-9 / np.deg2rad(seeing_arcsec / 3600)


def von_karman_nm2(f_per_m: np.ndarray, r0_m: float, outer_scale_m: float) -> np.ndarray:
    """Return the Von Kármán power spectral density of the OPD [nm² m²] at spatial frequencies `f_per_m`."""
    radians = VON_KARMAN * r0_m ** (-5 / 3) * (f_per_m**2 + outer_scale_m**-2) ** (-11 / 6)
    return radians * (SEEING_NM / (2 * np.pi)) ** 2


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


class InBandResidual:
    """In-band structure function on fixed baselines, and covariance of tilt and coma.

    The power law's PSD is a product ``f^(-slope) g(θ)``, so each harmonic ``a cos 2kθ`` of g gives the
    baselines of one length b a common factor (Jacobi–Anger): the mean of ``cos(2π f·b)`` is
    ``Σ_k a_k cos(2kφ) R_k(b)``, φ being the direction of the baseline and R_k the mean of
    ``(-1)^k J_2k(2πfb)`` over the frequencies. Everything is linear in frequencies and in g.

    The baselines (`bx_m`, `by_m`), (baselines,) each, are in metres.
    """

    def __init__(self, bx_m: np.ndarray, by_m: np.ndarray, band: ResidualBand):
        lengths, place = np.unique(np.round(np.hypot(bx_m, by_m), 9), return_inverse=True)
        # Rings of the band, as many as the baselines need: Gauss–Legendre in √f.
        lowest_per_m = LOWEST * band.low_per_m
        cycles = lengths.max() * (band.cutoff_per_m - lowest_per_m)
        nodes, weights = np.polynomial.legendre.leggauss(SPARE_NODES + int(np.ceil(2 * cycles)))
        low, high = np.sqrt([lowest_per_m, band.cutoff_per_m])
        root = (low + high + (high - low) * nodes) / 2
        f, area = root**2, 2 * root**2 * root * (high - low) * weights
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
        squares = (np.cos(theta) ** 2, np.cos(theta) * np.sin(theta), np.sin(theta) ** 2)
        self._squares = torch.as_tensor(np.array(squares).T / len(theta))
        self._products_m2 = torch.as_tensor(np.stack([bx_m**2, 2 * bx_m * by_m, by_m**2]))
        self._by_ring = _ByRing.of(f, band.low_per_m)
        self._aliasing = self._of_aliasing(f, area, theta, band.cutoff_per_m)

    def at(
        self,
        variance_nm2,
        slope,
        stretch_cos=0.0,
        stretch_sin=0.0,
        cross_cos=0.0,
        cross_sin=0.0,
        aliasing_nm2=0.0,
    ) -> Residual:
        """Return structure function and covariance; differentiable in every argument.

        The variances over the pupil are those of the power law's residual and of the aliased turbulence; the
        former's PSD is ``f^(-slope) exp(stretch_cos cos 2θ + stretch_sin sin 2θ + cross_cos cos 4θ + …)``.
        """
        w, g = self._frequencies(slope), self._angles((stretch_cos, stretch_sin, cross_cos, cross_sin))
        return self._sum(variance_nm2, self._residuals(w, g[None])[0], aliasing_nm2)

    def with_slopes(self, values: torch.Tensor) -> tuple[Residual, Residual]:
        """Return `at` for the arguments `values`, and its derivatives, arguments first."""
        variance_nm2, slope, *anisotropy, aliasing_nm2 = values
        w, g = self._frequencies(slope), self._angles(anisotropy)
        steeper = w * ((w * self._by_ring.kept * self._log_f).sum() - self._log_f)
        turned = g * (self._turns - (self._turns @ g / len(g))[:, None])
        own, *by_angles = self._residuals(w, torch.cat([g[None], turned]))
        shapes = [*self._residuals(steeper, g[None]), *by_angles]
        columns = zip(own, *shapes, self._aliasing, strict=True)
        slopes = (
            torch.stack([first, *(variance_nm2 * one for one in middle), last])
            for first, *middle, last in columns
        )
        return self._sum(variance_nm2, own, aliasing_nm2), Residual(*slopes)

    def _sum(self, variance_nm2, power_law: Residual, aliasing_nm2) -> Residual:
        """The residual of both parts; those of unit variance are given."""
        parts = zip(power_law, self._aliasing, strict=True)
        return Residual(*(variance_nm2 * one + aliasing_nm2 * other for one, other in parts))

    def _frequencies(self, slope) -> torch.Tensor:
        """Weight of each frequency, (frequencies,), for a variance of one over the pupil."""
        weights = torch.softmax(self._log_area - slope * self._log_f, 0)
        return weights / (weights * self._by_ring.kept).sum()

    def _angles(self, anisotropy) -> torch.Tensor:
        """Angular part of the PSD, of mean 1, (angles,)."""
        g = torch.exp(sum(factor * turn for factor, turn in zip(anisotropy, self._turns, strict=True)))
        return g / g.mean()

    def _residuals(self, frequencies: torch.Tensor, angles: torch.Tensor) -> list[Residual]:
        """The residuals of PSDs with these angular parts, (m, angles)."""
        radial = torch.einsum("lkf,f->lk", self._waves, frequencies).index_select(0, self._place)
        shapes = (self._directions * radial[:, None]).flatten(1)
        coherence = (shapes @ (angles @ self._harmonics).mT).mT
        total, squares = frequencies.sum() * angles.mean(1), angles @ self._squares
        tilt, with_coma = ((frequencies * one).sum() * squares for one in self._by_ring[1:])
        structure = 2 * (total[:, None] - coherence) - tilt @ self._products_m2
        return [Residual(*one) for one in zip(structure, with_coma, strict=True)]

    def _of_aliasing(
        self, f: np.ndarray, area: np.ndarray, theta: np.ndarray, cutoff_per_m: float
    ) -> Residual:
        """The residual of aliased turbulence, for a variance of one: one ring after the other."""
        psd = aliased_turbulence(f[:, None] * np.cos(theta), f[:, None] * np.sin(theta), cutoff_per_m)
        rings = torch.as_tensor(psd * area[:, None])
        rings = rings / (self._by_ring.kept @ rings.mean(1))
        radial = torch.einsum("lkf,fck->lck", self._waves, (rings @ self._harmonics).unflatten(1, (2, -1)))
        coherence = (self._directions * radial.index_select(0, self._place)).sum((1, 2))
        tilt, with_coma = (one @ rings @ self._squares for one in self._by_ring[1:])
        return Residual(2 * (rings.mean(1).sum() - coherence) - tilt @ self._products_m2, with_coma)


class Residual(NamedTuple):
    """What the OTF needs to know of a residual, or its derivatives, parameters first."""

    structure: torch.Tensor  # (..., baselines): structure function but for its last term [nm²]
    # (..., 3): covariance of tilt, as a slope, with coma, of Noll 7 or 8 [nm²/m]: both along x, one along
    # y, both along y
    tilt_with_coma: torch.Tensor


class _ByRing(NamedTuple):
    """What waves of one frequency, and of unit variance, have over the pupil, (frequencies,) each."""

    kept: torch.Tensor  # part of the variance that is not piston, tip or tilt
    # tilt, tilt_with_coma: variance of the tilt along the wave vector [1/m²], and its covariance with the
    # coma [1/m]
    tilt: torch.Tensor
    tilt_with_coma: torch.Tensor

    @classmethod
    def of(cls, f_per_m: np.ndarray, low_per_m: float) -> _ByRing:
        """Noll's transforms of Zernike polynomials, of a pupil of the diameter 1 / `low_per_m`."""
        radius_m = 0.5 / low_per_m
        z = 2 * np.pi * f_per_m * radius_m
        piston, tilt, coma = (2 * scipy.special.jv(order, z) / z for order in (1, 2, 4))
        per_m = 2 / radius_m  # slope of a unit coefficient of Noll 2 or 3
        parts = 1 - piston**2 - 4 * tilt**2, 4 * tilt**2 * per_m**2, -np.sqrt(4 * 8) * tilt * coma * per_m
        return cls(*(torch.as_tensor(one) for one in parts))


def aliased_turbulence(fx_per_m: np.ndarray, fy_per_m: np.ndarray, cutoff_per_m: float) -> np.ndarray:
    """Return the PSD of aliased turbulence inside the band, up to a factor.

    A sub-aperture of pitch d measures gradients ``∝ g φ(g) sinc(d gx) sinc(d gy)``. Sampled at d, those at
    ``g = f + k/d`` appear at f, where the least-squares reconstructor divides them by its own: the residual
    has ``Σ_k (f·g / f²)² [sinc(d g) / sinc(d f)]² |g|^(-11/3)``, k ≠ 0.

    The frequencies (`fx_per_m`, `fy_per_m`) are along the axes of the sensor's grid; `cutoff_per_m` is
    1/(2d).
    """
    pitch_m, folds = 0.5 / cutoff_per_m, range(-ALIASES, ALIASES + 1)
    psd = np.zeros(np.broadcast(fx_per_m, fy_per_m).shape)
    for gx, gy in [
        (fx_per_m + kx / pitch_m, fy_per_m + ky / pitch_m) for kx in folds for ky in folds if kx or ky
    ]:
        gradient = (fx_per_m * gx + fy_per_m * gy) * np.sinc(pitch_m * gx) * np.sinc(pitch_m * gy)
        psd += gradient**2 * (gx**2 + gy**2) ** (-11 / 6)
    own = (fx_per_m**2 + fy_per_m**2) * np.sinc(pitch_m * fx_per_m) * np.sinc(pitch_m * fy_per_m)
    return psd / own**2


def _even_bessel(z: np.ndarray) -> np.ndarray:
    """``(-1)^k J_2k(z)`` of z (m, n) for k up to `HARMONICS`, (m, harmonics + 1, n).

    The mean of ``cos(z cos α) cos 2kα`` over a quarter turn (Bessel's integral); over equal angles it is
    exact but for J of an order beyond z.
    """
    points = int(np.ceil((z.max() + 2 * HARMONICS + SPARE_ORDERS) / 4))
    angles = (np.arange(points) + 0.5) * np.pi / 2 / points
    table = np.cos(2 * np.arange(HARMONICS + 1)[:, None] * angles) / points
    return np.ascontiguousarray(np.swapaxes(np.cos(z[..., None] * np.cos(angles)) @ table.T, 1, 2))
