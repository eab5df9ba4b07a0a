"""Wavefronts as maps over the pupil."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from irlos_pipe.conventions.keys import Number, key
from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.optics.pupil import area_weighted_pupil, grid_centres
from irlos_pipe.optics.zernike import zernike_basis


def opd_maps_nm(nolls: Sequence[int], zernike_nm: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Return maps [nm], (..., n, n), of coefficients `zernike_nm`, (..., modes), NaN where there is no light.

    The samples across the diameter that are `lit`, (n, n), have y as the row index.
    """
    return np.where(lit, np.tensordot(zernike_nm, zernike_basis(nolls, *_disc(len(lit))), 1), np.nan)


def opd_sigma_nm(nolls: Sequence[int], covariance_nm2: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Return a map of the standard error [nm] of a wavefront of such a covariance, (modes, modes).

    Its variance at a place is ``zᵀ C z``, z the modes there; see `opd_maps_nm` for the map.
    """
    modes, sigma = modes_at(nolls, lit), np.full(lit.shape, np.nan)
    sigma[lit] = np.sqrt(np.maximum((modes * (covariance_nm2 @ modes)).sum(axis=0), 0.0))
    return sigma


@dataclass(frozen=True)
class MapSize:
    """RMS about the mean, and peak to valley, of a map of the wavefront over the clear pupil [nm]."""

    rms_nm: Number = key(math.nan, "RMS about the mean over the clear pupil.")
    pv_nm: Number = key(math.nan, "Peak to valley over the clear pupil.")

    @classmethod
    def of(cls, map_nm: np.ndarray) -> MapSize:
        """Return the size of `map_nm`, which is NaN where there is no light."""
        lit = map_nm[np.isfinite(map_nm)]
        return cls(float(lit.std()), float(np.ptp(lit))) if lit.size else cls()


def modes_at(nolls: Sequence[int], lit: np.ndarray) -> np.ndarray:
    """Return the Zernike polynomials `nolls` at the samples `lit` across the diameter, (modes, samples)."""
    x, y = _disc(len(lit))
    return zernike_basis(nolls, x[lit], y[lit])


def clear_pupil(geometry: PupilGeometry, samples: int) -> np.ndarray:
    """Where most of a sample is clear, (n, n), `samples` across; vanes of the `geometry` are included."""
    return area_weighted_pupil(geometry, grid_centres(samples, geometry.diameter_m / samples)) > 0.5


def clear_disc(geometry: PupilGeometry, samples: int) -> np.ndarray:
    """Return disc of the `geometry` without its central hole, (n, n), `samples` across; vanes are ignored."""
    radius = np.hypot(*_disc(samples))
    return (radius <= 1) & (radius >= geometry.obscuration_m / geometry.diameter_m)


def _disc(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates x and y across the diameter in units of the radius, (samples, samples) each."""
    x, y = np.meshgrid(*[grid_centres(samples, 2 / samples)] * 2)
    return x, y
