"""The 'phase bump' of MUSE-NFM as Zernike coefficients.

A ridge of Gaussian cross-sections, fitted to the static map that is published with TipTorch
(github.com/EjjeSynho/TipTorch, 206 nm RMS): the ridge leaves 86 nm RMS of it. It holds 186 nm RMS
beyond piston, tip and tilt, of which 62 nm beyond Noll 30, and 4 nm beyond Noll 120.
"""

from __future__ import annotations

import numpy as np

from irlos_pipe.optics.zernike import zernike_basis

PEAK_NM = 1140.0
CENTRE = (0.145, 0.901)  # x, y [pupil radii]
LENGTH, WIDTH = 0.546, 0.154  # standard deviations along and across [pupil radii]
DIRECTION_DEG = 42.6  # of the ridge, from +x towards +y
RADII, AZIMUTHS = 200, 360  # grid of points of equal area


def ridge_nm(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the height of the bump at the points `x`, `y` of the unit disc [nm]."""
    angle = np.radians(DIRECTION_DEG)
    dx, dy = x - CENTRE[0], y - CENTRE[1]
    along, across = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
    return PEAK_NM * np.exp(-(along**2) / (2 * LENGTH**2) - across**2 / (2 * WIDTH**2))


def phase_bump_nm(highest_noll: int = 120) -> dict[int, float]:
    """Return the coefficients of the bump over the disc, Noll 4 to `highest_noll`: nm RMS."""
    radius = np.sqrt((np.arange(RADII) + 0.5) / RADII)[:, None]
    azimuth = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
    x, y = (radius * np.cos(azimuth)).ravel(), (radius * np.sin(azimuth)).ravel()
    basis = zernike_basis(range(1, highest_noll + 1), x, y)
    values = np.linalg.lstsq(basis.T, ridge_nm(x, y), rcond=None)[0]
    return {noll: float(value) for noll, value in enumerate(values, start=1) if noll > 3}
