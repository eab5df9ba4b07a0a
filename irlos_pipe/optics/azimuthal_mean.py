"""Azimuthal means of images."""

from __future__ import annotations

import numpy as np


def ring_means(
    image: np.ndarray, centre_px: tuple[float, float], reach_px: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the radii [px] and azimuthal means of rings one pixel wide, (rings,) each.

    The rings lie about `centre_px`, row and column, out to `reach_px`, by default to the edge of the window.
    Values of the `image` that are not finite are left out; a ring without any others is NaN.
    """
    rows, columns = np.indices(image.shape)
    radius = np.hypot(rows - centre_px[0], columns - centre_px[1])
    edge = min(*centre_px, image.shape[0] - 1 - centre_px[0], image.shape[1] - 1 - centre_px[1])
    good = np.isfinite(image) & (radius < (max(edge, 1.0) if reach_px is None else reach_px))
    ring = radius[good].astype(int)
    count = np.bincount(ring)
    with np.errstate(invalid="ignore"):
        return np.bincount(ring, radius[good]) / count, np.bincount(ring, image[good]) / count
