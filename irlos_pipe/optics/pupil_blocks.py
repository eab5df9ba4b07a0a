"""A disc with a hole and vanes drawn in blocks of fine cells, one block per sample of the pupil.

Away from the edges all cells of a block are clear, or all are dark: only blocks that an edge touches, one in
ten, are drawn cell by cell.
"""

from __future__ import annotations

import numpy as np

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane
from irlos_pipe.optics.pupil_cover import across_m, axis, outline_cover, vane_cover


def filtered_in_blocks(
    geometry: PupilGeometry, fine_m: np.ndarray, filtering: np.ndarray, stop_m: tuple[float, float]
) -> np.ndarray:
    """Return the low-passed clear fraction of the fine cells of a plain pupil, (n, n).

    Parameters
    ----------
    geometry : PupilGeometry
        A disc with, at most, a hole and vanes.
    fine_m : ndarray, (n · cells,)
        Centres of the fine cells along either axis [m].
    filtering : ndarray, (n, n · cells)
        Low-pass along one axis.
    stop_m : (float, float)
        Position of the internal stop.
    """
    n = len(filtering)
    fine, step = fine_m.reshape(n, -1), float(fine_m[1] - fine_m[0])
    reach_m = (fine.shape[1] / np.sqrt(2) + 1) * step  # of a block; edges are a cell wide
    x, y = np.meshgrid(fine.mean(1), fine.mean(1))
    at_vanes = [_touched(vane, x, y, reach_m) for vane in geometry.vanes]
    rows, columns = np.nonzero(
        np.logical_or.reduce([_at_a_circle(geometry, x, y, reach_m, stop_m), *at_vanes])
    )
    cells_x, cells_y = fine[columns][:, None, :], fine[rows][:, :, None]
    cells = outline_cover(geometry, cells_x, cells_y, step, stop_m)
    for vane, there in zip(geometry.vanes, at_vanes, strict=True):
        own = there[rows, columns]
        cells[own] *= 1 - vane_cover(vane, cells_x[own], cells_y[own], step)
    clear = np.empty((n, fine.shape[1]) * 2)
    clear[:] = outline_cover(geometry, x, y, step, stop_m)[:, None, :, None]
    clear[rows, :, columns] = cells
    return filtering @ (clear.reshape(2 * fine_m.shape) @ filtering.T)


def _at_a_circle(
    geometry: PupilGeometry, x: np.ndarray, y: np.ndarray, reach_m: float, stop_m: tuple[float, float]
) -> np.ndarray:
    """Whether blocks at (`x`, `y`) may lie on a rim or on a hole, of the pupil or of the stop."""
    found = np.zeros(x.shape, dtype=bool)
    for x0, y0 in {(0.0, 0.0), stop_m}:
        radius = np.hypot(x - x0, y - y0)
        for diameter_m in (geometry.diameter_m, geometry.obscuration_m):
            found |= np.abs(radius - diameter_m / 2) < reach_m
    return found


def _touched(vane: Vane, x: np.ndarray, y: np.ndarray, reach_m: float) -> np.ndarray:
    """Whether a `vane` may touch blocks at (`x`, `y`)."""
    start, length, direction = axis(vane)
    along = (x - start[0]) * direction[0] + (y - start[1]) * direction[1]
    beside = np.abs(across_m(vane, x, y)) < vane.width_m / 2 + reach_m
    return beside & (along > -reach_m) & (along < length + reach_m)
