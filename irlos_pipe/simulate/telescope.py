"""The pupil on a grid, and the Zernikes on it (R. J. Noll, JOSA 66, 207, 1976)."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.special import eval_jacobi

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.conventions.units import MAS, NM


def noll_orders(noll: int) -> tuple[int, int]:
    """Return radial order n and signed azimuthal order m (m < 0: sine) of the index `noll`."""
    n = int((np.sqrt(8 * noll - 7) - 1) // 2)
    rank = noll - n * (n + 1) // 2  # 1 .. n + 1 within the order
    m = 2 * (rank // 2) if n % 2 == 0 else 2 * ((rank - 1) // 2) + 1
    return n, m if noll % 2 == 0 else -m


def zernike(noll: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return Zernike `noll` at (`x`, `y`) in units of the radius, of unit RMS and continued beyond 1.

    θ counts from +x towards +y.

    ``R_n^m(r) = (-1)^k r^m P_k^(m, 0)(1 - 2 r²)`` with ``k = (n - m) / 2`` and Jacobi's P.
    """
    n, m = noll_orders(noll)
    k = (n - abs(m)) // 2
    radial = (-1) ** k * eval_jacobi(k, abs(m), 0, 1 - 2 * (x**2 + y**2))
    turned = (x + 1j * y) ** abs(m)  # r^m exp(i m theta)
    azimuthal = turned.real if m >= 0 else turned.imag
    return np.sqrt((n + 1) * (1 if m == 0 else 2)) * radial * azimuthal


def sum_nm(parts: Iterable[Mapping[int, float]]) -> dict[int, float]:
    """Return the sum of the coefficients `parts`, Noll: nm RMS."""
    total: dict[int, float] = {}
    for part in parts:
        for noll, value_nm in part.items():
            total[noll] = total.get(noll, 0.0) + value_nm
    return total


def rotated_nm(zernike_nm: Mapping[int, float], angle_deg: float) -> dict[int, float]:
    """Return the coefficients `zernike_nm` of a wavefront turned anticlockwise by `angle_deg`."""
    parts: list[dict[int, float]] = []
    for noll, value_nm in zernike_nm.items():
        n, m = noll_orders(noll)
        angle = np.deg2rad(m * angle_deg)
        parts.append({noll: value_nm * float(np.cos(angle))})
        if m != 0:  # the same mode turned by a quarter of its period
            partner = noll + 1 if noll_orders(noll + 1) == (n, -m) else noll - 1
            parts.append({partner: value_nm * float(np.sin(angle))})
    return sum_nm(parts)


@dataclass(frozen=True, eq=False)
class Telescope:
    """Sampled pupil; row = y, column = x.

    Its cells have their centres at `u_m` (n,) along x and along y, symmetric about the optical axis [m];
    `transmission` (n, n) is the clear fraction of every cell.
    """

    geometry: PupilGeometry
    u_m: np.ndarray
    transmission: np.ndarray
    _modes: dict[int, np.ndarray] = field(init=False, repr=False, default_factory=dict)
    _fitters: dict[int, np.ndarray] = field(init=False, repr=False, default_factory=dict)
    _shares: dict[tuple[int, int], np.ndarray] = field(init=False, repr=False, default_factory=dict)

    @property
    def step_m(self) -> float:
        return float(self.u_m[1] - self.u_m[0])

    @property
    def area_m2(self) -> float:
        return float(self.transmission.sum()) * self.step_m**2

    def mode(self, noll: int) -> np.ndarray:
        """Return Zernike `noll` (n, n), of unit RMS over the unobscured disc and continued beyond it."""
        if noll not in self._modes:
            x, y = np.meshgrid(*[self.u_m * 2 / self.geometry.diameter_m] * 2)
            self._modes[noll] = zernike(noll, x, y)
        return self._modes[noll]

    def opd_nm(self, zernike_nm: Mapping[int, float]) -> np.ndarray:
        """Return the wavefront (n, n) [nm] of the coefficients `zernike_nm`, Noll: nm RMS."""
        start = np.zeros_like(self.transmission)
        return sum((value_nm * self.mode(noll) for noll, value_nm in zernike_nm.items()), start)

    def tilts_nm(self, motion_mas: np.ndarray) -> np.ndarray:
        """Wavefronts (times, n, n) [nm] that move the image by (times, 2) = (x, y) [mas]."""
        slopes = tilt_nm(1.0) * np.asarray(motion_mas)[:, :, None] * self.u_m
        return slopes[:, 0, None, :] + slopes[:, 1, :, None]

    def fit_zernike_nm(
        self, opd_nm: np.ndarray, last_noll: int, stated_nm: Mapping[int, float] | None = None
    ) -> np.ndarray:
        """Fit least-squares coefficients of Noll 2..`last_noll` over the pupil jointly with piston [nm RMS].

        Over an obscured pupil the polynomials are not orthogonal: what a wavefront has beyond the fitted
        modes falls on them. Where it is made of polynomials, these are better stated.

        Those of the wavefronts `opd_nm`, (..., n, n), are (..., last_noll - 1). Polynomials in them whose
        coefficients `stated_nm` (Noll: nm RMS) are known are exact in the result, and only the rest is
        fitted.
        """
        flat = np.reshape(opd_nm, (*np.shape(opd_nm)[:-2], -1))
        fitted_nm = flat[..., self._lit] @ self._fitter(last_noll).T
        # The fit is linear and returns modes up to the last as they are.
        beyond_nm = {noll: value for noll, value in (stated_nm or {}).items() if noll > last_noll}
        return fitted_nm - sum(value * self._taken_up(last_noll, noll) for noll, value in beyond_nm.items())

    def _taken_up(self, last_noll: int, beyond: int) -> np.ndarray:
        """What a fit of Noll 2..`last_noll` makes of a unit of the mode `beyond`, (last_noll - 1,)."""
        key = last_noll, beyond
        if key not in self._shares:
            self._shares[key] = self._fitter(last_noll) @ self.mode(beyond).ravel()[self._lit]
        return self._shares[key]

    @cached_property
    def _lit(self) -> np.ndarray:
        return np.flatnonzero(self.transmission)

    def _fitter(self, last_noll: int) -> np.ndarray:
        """Weighted pseudo-inverse without the row of piston, (last_noll - 1, lit cells)."""
        if last_noll not in self._fitters:
            modes = np.array([self.mode(noll).ravel()[self._lit] for noll in range(1, last_noll + 1)])
            weighted = modes * self.transmission.ravel()[self._lit]
            self._fitters[last_noll] = np.linalg.solve(weighted @ modes.T, weighted)[1:]
        return self._fitters[last_noll]


def tilt_nm(angle_mas: float) -> float:
    """Return the slope of the wavefront [nm per metre of pupil] that moves the image by `angle_mas`."""
    return angle_mas * MAS / NM
