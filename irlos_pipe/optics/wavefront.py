"""Wavefronts as maps over the pupil's disc, for drawings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from irlos_pipe.conventions.pupil import PupilGeometry
from irlos_pipe.optics.pupil import grid_centres
from irlos_pipe.optics.zernike import zernike_basis


def disc_maps_nm(
    geometry: PupilGeometry, nolls: Sequence[int], zernike_nm: np.ndarray, samples: int
) -> np.ndarray:
    """Maps of Zernike coefficients over the disc without its central hole; the vanes are not drawn.

    Parameters
    ----------
    zernike_nm : ndarray, (..., modes)
    samples : int
        Across the diameter.

    Returns
    -------
    ndarray, (..., samples, samples)
        NaN outside; row index is y.
    """
    x, y = np.meshgrid(*[grid_centres(samples, 2 / samples)] * 2)
    radius = np.hypot(x, y)
    lit = (radius <= 1) & (radius >= geometry.obscuration_m / geometry.diameter_m)
    maps = np.full((*np.shape(zernike_nm)[:-1], samples, samples), np.nan)
    maps[..., lit] = zernike_nm @ zernike_basis(nolls, x[lit], y[lit])
    return maps
