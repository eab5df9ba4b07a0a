"""How the drawn pupil changes when the internal stop moves, the vanes turn or widen, or the hole grows.

Only what lies near an edge changes. Edges are taken `WIDTH` cells wide: one cell would show the staircase of
the grid, four would miss what the low-pass lets through. A disc with a hole and vanes has few edges, which
are followed one by one; any other pupil is drawn twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane, turned, with_sizes
from irlos_pipe.optics.pupil import (
    ON_AXIS,
    PAD,
    across_m,
    axis,
    band_limited,
    filter_matrix,
    fine_centres,
    inside,
    outline_cover,
    vane_cover,
)

WIDTH = 1.5  # fine cells


def pupil_edges(geometry: PupilGeometry, samples: int, subsamples: int, stop_m: tuple[float, float]) -> Edges:
    """Return what gives the derivatives of a pupil; see `PupilEdges` for the parameters."""
    return (PupilEdges if geometry.plain else DrawnTwice)(geometry, samples, subsamples, stop_m)


class PupilEdges:
    """Edges of a plain pupil with an internal stop, as `pupil.band_limited` draws them.

    Parameters
    ----------
    geometry : PupilGeometry
    samples, subsamples : int
        See `pupil.band_limited`.
    stop_m : (float, float)
        Position of the stop.
    """

    def __init__(self, geometry: PupilGeometry, samples: int, subsamples: int, stop_m: tuple[float, float]):
        self.geometry, self.stop_m, self._subsamples = geometry, stop_m, subsamples
        self._fine = fine_centres(geometry, samples, subsamples)
        self._step = self._fine[1] - self._fine[0]
        self._filter = filter_matrix(samples + 2 * PAD, subsamples)

    def moved(self, along: tuple[float, float]) -> np.ndarray:
        """Return the derivative of the amplitude while the stop moves with a velocity, (n, n).

        Where stop and pupil coincide only the edges that darken count: the derivative is one-sided.
        """
        outer = self._rim(self.geometry.diameter_m / 2, along, sign=1)
        if self.geometry.obscuration_m == 0:
            return outer
        return outer + self._rim(self.geometry.obscuration_m / 2, along, sign=-1)

    def turned(self) -> np.ndarray:
        """Derivative of the amplitude while the vanes turn anticlockwise about the axis, (n, n) [1/rad]."""
        nothing = np.zeros(self._filter.shape[:1] * 2)
        return sum((self._turned_vane(vane) for vane in self.geometry.vanes), nothing)

    def obscured(self) -> np.ndarray:
        """Derivative of the amplitude while the diameter of the hole grows, (n, n) [1/m]."""
        (x0, y0), radius_m = self.stop_m, self.geometry.obscuration_m / 2

        def outside_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            """How far points lie outside the holes of pupil and stop."""
            return np.minimum(np.hypot(x, y), np.hypot(x - x0, y - y0)) - radius_m

        rows, columns, share = self._near(outside_m)
        x, y = self._fine[columns], self._fine[rows]
        clear = replace(self.geometry, obscuration_m=0.0)
        others = outline_cover(clear, x, y, self._step, self.stop_m) * self._between(clear.vanes, x, y)
        return self._filtered(rows, columns, -0.5 * share * others)

    def widened(self) -> np.ndarray:
        """Derivative of the amplitude while the mean width of the vanes grows, (n, n) [1/m]."""
        nothing, mean_m = np.zeros(self._filter.shape[:1] * 2), self.geometry.vane_width_m
        vanes = self.geometry.vanes
        return sum((self._vane_edges(v, lambda x, y: -0.5) * v.width_m / mean_m for v in vanes), nothing)

    def _rim(self, radius_m: float, along: tuple[float, float], sign: int) -> np.ndarray:
        """Of the stop's outline (sign 1) or hole (-1), where it is the edge that limits the light."""
        x0, y0 = self.stop_m
        rows, columns, share = self._near(lambda x, y: np.hypot(x - x0, y - y0) - radius_m)
        x, y = self._fine[columns], self._fine[rows]
        from_stop = np.hypot(x - x0, y - y0)
        rate = sign * ((x - x0) * along[0] + (y - y0) * along[1]) / from_stop
        beyond = sign * (from_stop - np.hypot(x, y))
        limits = (beyond > 0) | ((beyond == 0) & (rate < 0))
        change = share * limits * rate * self._between(self.geometry.vanes, x, y)
        return self._filtered(rows, columns, change)

    def _turned_vane(self, vane: Vane) -> np.ndarray:
        _, _, direction = axis(vane)
        return self._vane_edges(
            vane, lambda x, y: -np.sign(across_m(vane, x, y)) * (x * direction[0] + y * direction[1])
        )

    def _vane_edges(
        self, vane: Vane, rate_m: Callable[[np.ndarray, np.ndarray], np.ndarray | float]
    ) -> np.ndarray:
        """Of the two edges of one vane, where light appears at a rate [m] per unit of what changes."""
        rows, columns, share = self._near(lambda x, y: np.abs(across_m(vane, x, y)) - vane.width_m / 2)
        x, y = self._fine[columns], self._fine[rows]
        others = self._between([one for one in self.geometry.vanes if one is not vane], x, y)
        others *= outline_cover(self.geometry, x, y, self._step, self.stop_m)
        broad = replace(vane, width_m=vane.width_m + 4 * self._step)  # covers both edges between its ends
        change = share * rate_m(x, y) * others * vane_cover(broad, x, y, self._step)
        return self._filtered(rows, columns, change)

    def _near(
        self, distance_m: Callable[[np.ndarray, np.ndarray], np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows and columns of the cells at an edge, and how much of its width lies in each [1/m].

        They are looked for in coarse cells that the edge may cross.
        """
        coarse = self._fine.reshape(-1, self._subsamples).mean(1)
        reach_m = (self._subsamples / np.sqrt(2) + WIDTH) * self._step
        blocks = np.nonzero(np.abs(distance_m(coarse[None, :], coarse[:, None])) < reach_m)
        within = np.indices((self._subsamples,) * 2).reshape(2, 1, -1)
        rows, columns = (np.array(blocks)[:, :, None] * self._subsamples + within).reshape(2, -1)
        cells = distance_m(self._fine[columns], self._fine[rows]) / self._step
        share = (inside(cells + WIDTH / 2) - inside(cells - WIDTH / 2)) / (WIDTH * self._step)
        some = share > 0
        return rows[some], columns[some], share[some]

    def _between(self, vanes: Sequence[Vane], x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Part of cells that vanes leave clear."""
        clear = np.ones(len(x))
        for vane in vanes:
            clear *= 1 - vane_cover(vane, x, y, self._step)
        return clear

    def _filtered(self, rows: np.ndarray, columns: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Low-passed change of a few cells, (n, n)."""
        size = len(self._fine)
        return self._filter @ (sparse.csr_array((change, (rows, columns)), (size, size)) @ self._filter.T)


class DrawnTwice:
    """Any pupil with an internal stop, whose derivatives are differences of two drawings.

    Parameters
    ----------
    geometry, samples, subsamples, stop_m
        See `PupilEdges`.
    """

    def __init__(self, geometry: PupilGeometry, samples: int, subsamples: int, stop_m: tuple[float, float]):
        self._geometry, self._samples, self._subsamples = geometry, samples, subsamples
        self._stop_m = stop_m
        self._step_m = WIDTH * geometry.diameter_m / samples / subsamples

    def moved(self, along: tuple[float, float]) -> np.ndarray:
        """See `PupilEdges.moved`: one-sided where stop and pupil coincide."""
        speed = float(np.hypot(*along))
        if speed == 0:
            return np.zeros((self._samples + 2 * PAD,) * 2)
        ahead, behind = self._step_m / speed, -self._step_m / speed
        if self._stop_m == ON_AXIS:
            behind = 0.0
        return (self._with_stop(along, ahead) - self._with_stop(along, behind)) / (ahead - behind)

    def turned(self) -> np.ndarray:
        """See `PupilEdges.turned`; of a drawn aperture, the whole pupil turns."""
        angle = self._step_m / (self._geometry.diameter_m / 2)
        later, before = (
            self._drawn(turned(self._geometry, np.rad2deg(a)), self._stop_m) for a in (angle, -angle)
        )
        return (later - before) / (2 * angle)

    def obscured(self) -> np.ndarray:
        """See `PupilEdges.obscured`."""
        size_m = self._geometry.obscuration_m
        return self._between(*(with_sizes(self._geometry, obscuration_m=size_m + s) for s in self._steps_m))

    def widened(self) -> np.ndarray:
        """See `PupilEdges.widened`."""
        size_m = self._geometry.vane_width_m
        return self._between(*(with_sizes(self._geometry, vane_width_m=size_m + s) for s in self._steps_m))

    @property
    def _steps_m(self) -> tuple[float, float]:
        return self._step_m, -self._step_m

    def _between(self, larger: PupilGeometry, smaller: PupilGeometry) -> np.ndarray:
        """Difference of two drawings over twice the step."""
        later, before = (self._drawn(one, self._stop_m) for one in (larger, smaller))
        return (later - before) / (2 * self._step_m)

    def _with_stop(self, along: tuple[float, float], time: float) -> np.ndarray:
        stop_m = (self._stop_m[0] + time * along[0], self._stop_m[1] + time * along[1])
        return self._drawn(self._geometry, stop_m)

    def _drawn(self, geometry: PupilGeometry, stop_m: tuple[float, float]) -> np.ndarray:
        return band_limited(geometry, self._samples, stop_m=stop_m, subsamples=self._subsamples)


Edges = PupilEdges | DrawnTwice
