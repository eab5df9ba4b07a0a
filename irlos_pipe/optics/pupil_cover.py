"""How much of small cells the parts of a pupil cover, from the distance to each edge."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane
from irlos_pipe.conventions.pupil_parts import Part

ON_AXIS = (0.0, 0.0)


def outline_cover(
    geometry: PupilGeometry, x: np.ndarray, y: np.ndarray, step: float, stop_m: tuple[float, float]
) -> np.ndarray:
    """Return the fraction of each sub-cell inside the outlines and outside the holes of pupil and stop.

    Parameters
    ----------
    geometry : PupilGeometry
    x, y, step : ndarray, ndarray, float
        Centres of the sub-cells and their side [m]; where an aperture is drawn, a row and a column.
    stop_m : (float, float)
        See `band_limited`.
    """
    largest = smallest = np.sqrt(x**2 + y**2)
    if stop_m != ON_AXIS:
        from_stop = np.sqrt((x - stop_m[0]) ** 2 + (y - stop_m[1]) ** 2)
        largest, smallest = np.maximum(largest, from_stop), np.minimum(smallest, from_stop)
    if not geometry.aperture:
        clear = inside((geometry.diameter_m / 2 - largest) / step)
    else:
        clear = parts_cover(geometry.aperture, x, y, step)
        if stop_m != ON_AXIS:
            stop = [part.outline for part in geometry.aperture]
            clear = np.minimum(clear, parts_cover(stop, x - stop_m[0], y - stop_m[1], step))
    if geometry.obscuration_m > 0:
        clear *= inside((smallest - geometry.obscuration_m / 2) / step)
    return clear


def parts_cover(parts: Sequence[Part], x: np.ndarray, y: np.ndarray, step: float) -> np.ndarray:
    """Return the fraction of each sub-cell that `parts`, which do not overlap, cover, (rows, columns).

    Parameters
    ----------
    parts : sequence of Part
    x, y : ndarray, (1, columns) and (rows, 1)
        Centres of the sub-cells [m].
    step : float
        Their side [m].
    """
    covered = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    for piece in (piece for part in parts for piece in part.pieces):
        rows, columns = box(piece, x, y, step)
        covered[rows, columns] += piece.cover(x[:, columns], y[rows], step)
    return covered


def box(piece: Part, x: np.ndarray, y: np.ndarray, step: float) -> tuple[slice, slice]:
    """Rows and columns of a grid that a `piece` may touch; `x`, `y` and `step` as of `parts_cover`."""
    centre, reach = piece.placement.shift_m, piece.radius_m + step
    return _span(y[:, 0], centre[1], reach), _span(x[0], centre[0], reach)


def _span(axis_m: np.ndarray, centre_m: float, reach_m: float) -> slice:
    return slice(*np.searchsorted(axis_m, [centre_m - reach_m, centre_m + reach_m]))


def inside(distance_cells: np.ndarray) -> np.ndarray:
    """Return the covered fraction of a cell whose centre lies `distance_cells` inside an edge."""
    return np.clip(distance_cells + 0.5, 0.0, 1.0)


def vane_cover(vane: Vane, x: np.ndarray, y: np.ndarray, step: float) -> np.ndarray:
    """Return the fraction that a `vane` covers of each sub-cell of side `step` at (`x`, `y`) [m]."""
    start, length, direction = axis(vane)
    along = (x - start[0]) * direction[0] + (y - start[1]) * direction[1]
    across, half = across_m(vane, x, y), vane.width_m / 2
    width = inside((across + half) / step) + inside((half - across) / step) - 1
    return np.clip(width, 0, 1) * inside(along / step) * inside((length - along) / step)


def across_m(vane: Vane, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the distance of (`x`, `y`) to the left of the axis of a `vane` [m]."""
    start, _, direction = axis(vane)
    return (y - start[1]) * direction[0] - (x - start[0]) * direction[1]


def axis(vane: Vane) -> tuple[np.ndarray, float, np.ndarray]:
    """Return where a vane starts, its length, and its direction."""
    start, end = np.array(vane.start_m), np.array(vane.end_m)
    length = float(np.hypot(*(end - start)))
    return start, length, (end - start) / length
