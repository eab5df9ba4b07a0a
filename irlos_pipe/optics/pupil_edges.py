"""How the drawn pupil changes when the internal stop moves, the vanes turn or widen, or the hole grows.

Only what lies near an edge changes. Edges are taken `WIDTH` cells wide: one cell would show the staircase of
the grid, four would miss what the low-pass lets through. A disc with a hole and vanes has few edges, which
are followed one by one; any other pupil is drawn twice, which takes 6 to 28 times as long and errs 2 to 5
times as much where a stop moves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy

from irlos_pipe.conventions.pupil_drawing import (
    ON_AXIS,
    PupilGeometry,
    Vane,
    inside,
    outline_cover,
    turned,
    with_sizes,
)
from irlos_pipe.optics.pupil import (
    PAD,
    Division,
    band_limited,
    band_limited_parts,
    filter_matrix,
    fine_centres,
)

WIDTH = 1.5  # of an edge, in fine cells: one cell would show the staircase
Distance = Callable[[np.ndarray, np.ndarray], np.ndarray]


def pupil_edges(
    geometry: PupilGeometry,
    samples: int,
    subsamples: int,
    stop_m: tuple[float, float],
    division: Division | None = None,
) -> Edges:
    """Return what gives the derivatives of a pupil; see `DrawnEdges` for the parameters."""
    return (PupilEdges if geometry.plain else DrawnTwice)(geometry, samples, subsamples, stop_m, division)


class _Cells(NamedTuple):
    """Cells at an edge: their rows and columns, their places [m], and how much of its width is in each [1/m].

    In what is not dark for other reasons.
    """

    rows: np.ndarray
    columns: np.ndarray
    x: np.ndarray
    y: np.ndarray
    share: np.ndarray

    def seen(self, clear: np.ndarray) -> _Cells:
        """The same cells, of which the part `clear` is not dark for other reasons."""
        return self._replace(share=self.share * clear)


class DrawnEdges:
    """Edges of a pupil with an internal stop at `stop_m`, as `pupil.band_limited` draws them.

    With a `division`, derivatives are those of all its parts, (parts, n, n).
    """

    def __init__(
        self,
        geometry: PupilGeometry,
        samples: int,
        subsamples: int,
        stop_m: tuple[float, float],
        division: Division | None = None,
    ):
        self.geometry, self.stop_m, self.division = geometry, stop_m, division
        self._samples, self._subsamples = samples, subsamples

    @property
    def shape(self) -> tuple[int, ...]:
        """Of a derivative."""
        parts = () if self.division is None else (self.division.count,)
        return (*parts, *(self._samples + 2 * PAD,) * 2)


class PupilEdges(DrawnEdges):
    @cached_property
    def _fine(self) -> np.ndarray:
        """Coordinates along either axis of the fine cells [m]."""
        return fine_centres(self.geometry, self._samples, self._subsamples)

    @property
    def _step(self) -> float:
        return self._fine[1] - self._fine[0]

    @property
    def _filter(self) -> np.ndarray:
        return filter_matrix(self._samples + 2 * PAD, self._subsamples)

    def moved(self, along: tuple[float, float]) -> np.ndarray:
        """Return the derivative of the amplitude while the stop moves with a velocity, (n, n).

        Where stop and pupil coincide only the edges that darken count: the derivative is one-sided.
        """
        (x0, y0), changes = self.stop_m, []
        for cells, sign in zip(self._rims, (1, -1), strict=False):
            from_stop = np.hypot(cells.x - x0, cells.y - y0)
            rate = sign * ((cells.x - x0) * along[0] + (cells.y - y0) * along[1]) / from_stop
            beyond = sign * (from_stop - np.hypot(cells.x, cells.y))
            changes.append(rate * ((beyond > 0) | ((beyond == 0) & (rate < 0))))
        return self._filtered(self._rims, changes)

    def turned(self) -> np.ndarray:
        """Derivative of the amplitude while the vanes turn anticlockwise about the axis, (n, n) [1/rad]."""
        changes = []
        for vane, cells in zip(self.geometry.vanes, self._vanes, strict=True):
            _, _, direction = vane.axis
            outwards = cells.x * direction[0] + cells.y * direction[1]
            changes.append(-np.sign(vane.across_m(cells.x, cells.y)) * outwards)
        return self._filtered(self._vanes, changes)

    def obscured(self) -> np.ndarray:
        """Derivative of the amplitude while the diameter of the hole grows, (n, n) [1/m]."""
        (x0, y0), radius_m = self.stop_m, self.geometry.obscuration_m / 2

        def outside_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            """How far points lie outside the holes of pupil and stop."""
            return np.minimum(np.hypot(x, y), np.hypot(x - x0, y - y0)) - radius_m

        cells, clear = self._near(outside_m), replace(self.geometry, obscuration_m=0.0)
        others = outline_cover(clear, cells.x, cells.y, self._step, self.stop_m)
        others = others * self._between(clear.vanes, cells)
        return self._filtered([cells], [-0.5 * others])

    def widened(self) -> np.ndarray:
        """Derivative of the amplitude while the mean width of the vanes grows, (n, n) [1/m]."""
        mean_m, pairs = self.geometry.vane_width_m, zip(self.geometry.vanes, self._vanes, strict=True)
        changes = [np.full(len(cells.x), -0.5 * vane.width_m / mean_m) for vane, cells in pairs]
        return self._filtered(self._vanes, changes)

    @cached_property
    def _rims(self) -> list[_Cells]:
        """The stop's outline and, where there is one, its hole."""
        diameters_m = self.geometry.diameter_m, self.geometry.obscuration_m
        found = [self._near(self._outside(diameter_m / 2)) for diameter_m in diameters_m if diameter_m > 0]
        return [cells.seen(self._between(self.geometry.vanes, cells)) for cells in found]

    def _outside(self, radius_m: float) -> Distance:
        """How far points lie outside a circle about the middle of the stop [m]."""
        x0, y0 = self.stop_m
        return lambda x, y: np.hypot(x - x0, y - y0) - radius_m

    @cached_property
    def _vanes(self) -> list[_Cells]:
        return [self._vane_edges(vane) for vane in self.geometry.vanes]

    def _vane_edges(self, vane: Vane) -> _Cells:
        broad = replace(vane, width_m=vane.width_m + 4 * self._step)  # covers both edges between its ends
        middle, reach_m = (np.array(vane.start_m) + vane.end_m) / 2, vane.axis[1] / 2

        def outside_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            return np.abs(vane.across_m(x, y)) - vane.width_m / 2

        def beyond_m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            return np.hypot(x - middle[0], y - middle[1]) - reach_m - broad.width_m

        cells = self._near(outside_m, beyond_m)
        others = self._between([one for one in self.geometry.vanes if one is not vane], cells)
        others *= outline_cover(self.geometry, cells.x, cells.y, self._step, self.stop_m)
        return cells.seen(others * broad.cover(cells.x, cells.y, self._step))

    def _near(self, distance_m: Distance, beyond_m: Distance | None = None) -> _Cells:
        """Cells at the edge whose signed distance is `distance_m`; none where `beyond_m` is positive.

        They are looked for in coarse cells that the edge may cross.
        """
        coarse = self._fine.reshape(-1, self._subsamples).mean(1)
        reach_m = (self._subsamples / np.sqrt(2) + WIDTH) * self._step
        crossed = np.abs(distance_m(coarse[None, :], coarse[:, None])) < reach_m
        if beyond_m is not None:
            crossed &= beyond_m(coarse[None, :], coarse[:, None]) < reach_m
        within = np.indices((self._subsamples,) * 2).reshape(2, 1, -1)
        blocks = np.array(np.nonzero(crossed))
        rows, columns = (blocks[:, :, None] * self._subsamples + within).reshape(2, -1)
        cells = distance_m(self._fine[columns], self._fine[rows]) / self._step
        share = (inside(cells + WIDTH / 2) - inside(cells - WIDTH / 2)) / (WIDTH * self._step)
        some = np.flatnonzero(share)
        rows, columns = rows[some], columns[some]
        return _Cells(rows, columns, self._fine[columns], self._fine[rows], share[some])

    def _between(self, vanes: Sequence[Vane], cells: _Cells) -> np.ndarray:
        """Part of `cells` that `vanes` leave clear."""
        clear = np.ones(len(cells.x))
        for vane in vanes:
            clear *= 1 - vane.cover(cells.x, cells.y, self._step)
        return clear

    def _filtered(self, edges: Sequence[_Cells], changes: Sequence[np.ndarray]) -> np.ndarray:
        """Low-passed change at some edges, each with a rate at which light appears there [m], (n, n)."""
        if not edges:
            return np.zeros(self.shape)
        values = np.concatenate([cells.share * rate for cells, rate in zip(edges, changes, strict=True)])
        rows, columns = (np.concatenate([cells[axis] for cells in edges]) for axis in (0, 1))
        if self.division is None:
            return self._low_passed(values, rows, columns)
        index = self.division.index(self._fine[columns], self._fine[rows])
        parts = range(self.division.count)
        return np.stack([self._low_passed(values * (index == part), rows, columns) for part in parts])

    def _low_passed(self, values: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        size = len(self._fine)
        return self._filter @ (
            scipy.sparse.csr_array((values, (rows, columns)), (size, size)) @ self._filter.T
        )


class DrawnTwice(DrawnEdges):
    """Any pupil, whose derivatives are differences of two drawings."""

    @property
    def _step_m(self) -> float:
        return WIDTH * self.geometry.diameter_m / self._samples / self._subsamples

    def moved(self, along: tuple[float, float]) -> np.ndarray:
        """See `PupilEdges.moved`: one-sided where stop and pupil coincide."""
        speed = float(np.hypot(*along))
        if speed == 0:
            return np.zeros(self.shape)
        ahead, behind = self._step_m / speed, -self._step_m / speed
        if self.stop_m == ON_AXIS:
            behind = 0.0
        later, before = (
            self._drawn(self.geometry, (self.stop_m[0] + t * along[0], self.stop_m[1] + t * along[1]))
            for t in (ahead, behind)
        )
        return (later - before) / (ahead - behind)

    def turned(self) -> np.ndarray:
        """See `PupilEdges.turned`; of a drawn aperture, the whole pupil turns."""
        angle = self._step_m / (self.geometry.diameter_m / 2)
        return self._slope(lambda by: turned(self.geometry, np.rad2deg(by)), angle)

    def obscured(self) -> np.ndarray:
        size_m = self.geometry.obscuration_m
        return self._slope(lambda by: with_sizes(self.geometry, obscuration_m=size_m + by), self._step_m)

    def widened(self) -> np.ndarray:
        size_m = self.geometry.vane_width_m
        return self._slope(lambda by: with_sizes(self.geometry, vane_width_m=size_m + by), self._step_m)

    def _slope(self, changed: Callable[[float], PupilGeometry], step: float) -> np.ndarray:
        """Central difference of drawings of the pupil `changed` by a step either way."""
        later, before = (self._drawn(changed(by), self.stop_m) for by in (step, -step))
        return (later - before) / (2 * step)

    def _drawn(self, geometry: PupilGeometry, stop_m: tuple[float, float]) -> np.ndarray:
        options: Any = {"stop_m": stop_m, "subsamples": self._subsamples}
        if self.division is None:
            return band_limited(geometry, self._samples, **options)
        return band_limited_parts(geometry, self._samples, self.division, **options)


Edges = PupilEdges | DrawnTwice
