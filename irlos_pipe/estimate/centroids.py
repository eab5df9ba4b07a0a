"""Low orders from the centroids of four images: what a 2x2 Shack–Hartmann sensor does.

The centre of light of a lenslet's image lies where the mean slope of the wavefront over it points, whatever
else the wavefront does (the intensity-weighted mean of a transform's coordinate is the mean gradient of the
phase), as long as the window holds all the light. It does not, and read noise forbids to sum it all: pixels
below a threshold are left out, at the price of a gain that is not quite one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.conventions.units import MAS, NM

NOLLS = (2, 3, 4, 5, 6)
SIDES = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])  # (x, y): lower left and right, upper left and right
THRESHOLD_SIGMA, THRESHOLD_PEAK = 3.0, 0.05  # of the noise of a pixel, and of the brightest pixel


def gradient_matrix(geometry: PupilGeometry, nolls: Sequence[int] = NOLLS) -> np.ndarray:
    """Return the displacement of the four images per nm RMS of each mode, (8, modes) [mas/nm].

    Rows are x and y of every lenslet: the mean slopes over a quarter of an annulus from r to R, whose mean x
    and y are ``4 (R³ - r³) / 3π (R² - r²)``; vanes are left out.

    Parameters
    ----------
    geometry : PupilGeometry
        Its diameter and central hole.
    nolls : sequence of int
        From 2 to 6.
    """
    outer, inner = geometry.diameter_m / 2, geometry.obscuration_m / 2
    middle = 4 * (outer**3 - inner**3) / (3 * np.pi * (outer**2 - inner**2)) / outer
    x, y = middle * SIDES.T
    one, none = np.ones(len(SIDES)), np.zeros(len(SIDES))
    slopes = {  # of the modes in units of the radius
        2: (2 * one, none),
        3: (none, 2 * one),
        4: (4 * np.sqrt(3) * x, 4 * np.sqrt(3) * y),
        5: (2 * np.sqrt(6) * y, 2 * np.sqrt(6) * x),
        6: (2 * np.sqrt(6) * x, -2 * np.sqrt(6) * y),
    }
    columns = [np.stack(slopes[noll], axis=1).ravel() for noll in nolls]
    return np.stack(columns, axis=1) / outer * NM / MAS


def centroids_mas(images_e: np.ndarray, pixel_scale_mas: float, noise_e: float) -> np.ndarray:
    """Return the centres of light of the four images, (frames, 4, 2) as (x, y) from the window's centre.

    Parameters
    ----------
    images_e : ndarray, (frames, 2 rows, 2 columns)
        Side by side.
    pixel_scale_mas : float
    noise_e : float
        Of a dark pixel.
    """
    frames, rows, columns = len(images_e), images_e.shape[1] // 2, images_e.shape[2] // 2
    apart = images_e.astype(float).reshape(frames, 2, rows, 2, columns)
    apart = apart.transpose(0, 1, 3, 2, 4).reshape(frames, 4, rows, columns)
    peak = apart.max(axis=(2, 3), keepdims=True)
    bright = np.maximum(apart - np.maximum(THRESHOLD_SIGMA * noise_e, THRESHOLD_PEAK * peak), 0)
    light = np.maximum(bright.sum(axis=(2, 3)), 1e-300)
    x = (bright.sum(axis=2) @ (np.arange(columns) - (columns - 1) / 2)) / light
    y = (bright.sum(axis=3) @ (np.arange(rows) - (rows - 1) / 2)) / light
    return np.stack([x, y], axis=2) * pixel_scale_mas


def modes_of_centroids_nm(
    images_e: np.ndarray,
    geometry: PupilGeometry,
    pixel_scale_mas: float,
    noise_e: float,
    nolls: Sequence[int] = NOLLS,
) -> np.ndarray:
    """Return the modes that move the four images most nearly as they are, (frames, modes) [nm RMS].

    `images_e`, `pixel_scale_mas` and `noise_e` are as of `centroids_mas`, `geometry` and `nolls` as of
    `gradient_matrix`.
    """
    displaced = centroids_mas(images_e, pixel_scale_mas, noise_e).reshape(len(images_e), -1)
    return displaced @ np.linalg.pinv(gradient_matrix(geometry, nolls)).T
