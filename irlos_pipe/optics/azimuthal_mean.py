"""Azimuthal means of images."""

from __future__ import annotations

import numpy as np


def ring_means(
    image: np.ndarray, centre_px: tuple[float, float], reach_px: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the azimuthal means in rings one pixel wide.

    Parameters
    ----------
    image : ndarray, (rows, columns)
        Values that are not finite are left out.
    centre_px : tuple of float
        Row and column of the rings' centre.
    reach_px : float, optional
        Radius of the outermost ring; that inside the window by default.

    Returns
    -------
    radius_px, mean : ndarray, (rings,)
        NaN for a ring without finite values.
    """
    rows, columns = np.indices(image.shape)
    radius = np.hypot(rows - centre_px[0], columns - centre_px[1])
    edge = min(*centre_px, image.shape[0] - 1 - centre_px[0], image.shape[1] - 1 - centre_px[1])
    good = np.isfinite(image) & (radius < (max(edge, 1.0) if reach_px is None else reach_px))
    ring = radius[good].astype(int)
    count = np.bincount(ring)
    with np.errstate(invalid="ignore"):
        return np.bincount(ring, radius[good]) / count, np.bincount(ring, image[good]) / count
