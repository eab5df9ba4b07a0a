"""The pupil as an object: where light passes."""

from __future__ import annotations

import numpy as np

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane

FINEST_CELL_M = 0.002  # of the brute-force drawing: a twentieth of a vane


def centres(count: int, step: float) -> np.ndarray:
    """Return the positions of `count` points `step` apart, symmetric about 0."""
    return (np.arange(count) - (count - 1) / 2) * step


def clear_fraction(
    geometry: PupilGeometry, u_m: np.ndarray, stop_m: tuple[float, float] | None = None
) -> np.ndarray:
    """Return the clear fraction of every cell of a square grid, by counting points on a much finer one.

    Parameters
    ----------
    geometry : PupilGeometry
    u_m : ndarray, (n,)
        Centres of the cells along x and along y [m].
    stop_m : (float, float), optional
        Position (x, y) of an internal stop, which has the outline and the central hole but no vanes.

    Returns
    -------
    ndarray, (n, n), row = y
    """
    step = u_m[1] - u_m[0]
    points = max(2, int(np.ceil(step / FINEST_CELL_M)))
    inner = centres(points, step / points)
    x = (u_m[:, None] + inner).ravel()[None, :]
    rows = []
    for centre_m in u_m:
        y = (centre_m + inner)[:, None]
        clear = is_clear(geometry, x, y)
        if stop_m is not None:
            clear &= inside_annulus(geometry, x - stop_m[0], y - stop_m[1])
        rows.append(clear.reshape(points, len(u_m), points).mean(axis=(0, 2)))
    return np.array(rows)


def is_clear(geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return whether light passes the pupil `geometry` at the points (`x_m`, `y_m`)."""
    clear = inside_annulus(geometry, x_m, y_m)
    for vane in geometry.vanes:
        clear &= ~_behind(vane, x_m, y_m)
    return clear


def inside_annulus(geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return whether the points (`x_m`, `y_m`) lie inside the annulus of `geometry`; vanes are ignored."""
    radius2 = x_m**2 + y_m**2
    return (radius2 <= geometry.diameter_m**2 / 4) & (radius2 >= geometry.obscuration_m**2 / 4)


def _behind(vane: Vane, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return whether the vane covers the points."""
    (x0, y0), (x1, y1) = vane.start_m, vane.end_m
    length = np.hypot(x1 - x0, y1 - y0)
    cos, sin = (x1 - x0) / length, (y1 - y0) / length
    along = (x_m - x0) * cos + (y_m - y0) * sin
    across = (y_m - y0) * cos - (x_m - x0) * sin
    return (along >= 0) & (along <= length) & (np.abs(across) <= vane.width_m / 2)
