"""The telescope pupil sampled by area, and how it changes when stop, vanes or hole do."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import scipy

from irlos_pipe.conventions.pupil_drawing import (
    ON_AXIS,
    PupilGeometry,
    Vane,
    clear_fraction,
    inside,
    outline_cover,
    turned,
    with_sizes,
)
from irlos_pipe.conventions.pupil_parts import anticlockwise_from_first

SUBSAMPLES = 16  # fine cells per side of a coarse cell; coverage of a fine cell is linear in distance
ROWS_AT_A_TIME = 64
NOTHING_BEFORE_IT: dict = {"obscuration_m": 0.0, "vanes": (), "obstructions": ()}  # a bare aperture
PAD = 4  # coarse cells beyond the diameter on each side: room for the filter's ringing
PASS_BAND, STOP_BAND = 0.7, 1.4  # of the low-pass, in units of the coarse grid's Nyquist frequency
Shares = Callable[[np.ndarray, np.ndarray, float], Iterable[tuple[int, slice, np.ndarray]]]
Index = Callable[[np.ndarray, np.ndarray], np.ndarray]  # number of the part at points (x, y) [m]
CLEAN_BAND = min(PASS_BAND, 2 - STOP_BAND)  # neither attenuated nor reached by what folds back
LABELLED = 1024  # cells across the diameter of the drawing in which connected parts are looked for
WIDEST_GAP = 0.02  # of the diameter: a vane that ends this close to the rim parts petals all the same
NARROWEST = 3  # cells: thinner vanes are drawn that wide there
SMALLEST = 0.01  # of the clear area: what is smaller belongs to the adjacent petal
WIDTH = (
    1.5  # of an edge, in fine cells: one would show the staircase of the grid, four miss what is let through
)
Distance = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Division:
    index: Index  # number of the part at, or nearest to, points; arrays that broadcast
    count: int
    shared: Shares | None = None  # see `shares`; without it a cell belongs to the part at its middle

    def shares(
        self, x_m: np.ndarray, y_m: np.ndarray, step_m: float
    ) -> Iterator[tuple[int, slice, np.ndarray]]:
        """Yield which light of some cells the parts have that touch them.

        The middles of the cells, of the side `step_m`, are `x_m`, (1, columns), and `y_m`, (rows, 1).
        Yielded are numbers of parts, each with a slice of columns and its share of the light of each cell
        there.
        """
        if self.shared:
            yield from self.shared(x_m, y_m, step_m)
            return
        index = self.index(x_m, y_m)
        for number in range(self.count):
            inside = index == number
            columns = np.flatnonzero(inside.any(0))
            if len(columns):
                touched = slice(int(columns[0]), int(columns[-1]) + 1)
                yield number, touched, inside[:, touched]


def grid_centres(samples: int, step_m: float) -> np.ndarray:
    """Return the coordinates of `samples` points `step_m` apart, symmetric about 0 [m]."""
    return (np.arange(samples) - (samples - 1) / 2) * step_m


def area_weighted_pupil(geometry: PupilGeometry, centres_m: np.ndarray) -> np.ndarray:
    """Return the transmitted fraction, 0 to 1, of every cell of a square grid, (samples, samples).

    The row index is y. The equally spaced `centres_m`, (samples,), are those of cells along x and along y
    [m].
    """
    return np.concatenate([clear for _, clear in _by_rows(geometry, centres_m, ON_AXIS)])


@lru_cache(maxsize=8)
def band_limited_pupil(geometry: PupilGeometry, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the pupil amplitude whose sampled spectrum is that of the sharp-edged pupil where it matters.

    The area-weighted pupil of a grid `SUBSAMPLES` times finer is low-passed: flat up to
    0.7 of the coarse grid's Nyquist frequency (with the sinc of the fine cell taken out),
    a squared cosine to zero at 1.4 times it. A window of a few tens of lambda/D sees only
    the flat part, so sharp edges and thin vanes cost no resolution: at equal accuracy the
    grid is about half as fine per axis as an area-weighted one.

    Returns the coordinates of the grid [m], n = samples + 2 PAD, of which `samples` lie across the
    diameter, and the amplitude (n, n), which may ring slightly below 0 and above 1.
    """
    total = samples + 2 * PAD
    u_m, amplitude = grid_centres(total, geometry.diameter_m / samples), band_limited(geometry, samples)
    u_m.flags.writeable = amplitude.flags.writeable = False  # they are shared by all callers
    return u_m, amplitude


@lru_cache(maxsize=8)
def transmitted_cells(geometry: PupilGeometry, samples: int) -> float:
    """Return the light that a pupil passes, as a number of clear cells of `band_limited_pupil`.

    `geometry` and `samples` are those of the pupil.
    """
    if geometry.map is None:
        # The pupil is clear or opaque, so ∫P² = ∫P, and the mean survives the band limit.
        return float(np.sum(band_limited_pupil(geometry, samples)[1]))
    fine, alone = fine_centres(geometry, samples, SUBSAMPLES), replace(geometry, **NOTHING_BEFORE_IT)
    kept, whole = (
        sum(float(np.sum(clear**2)) for _, clear in _by_rows(pupil, fine, ON_AXIS))
        for pupil in (geometry, alone)
    )
    return geometry.map.light_m2 / (geometry.diameter_m / samples) ** 2 * kept / whole


def band_limited(
    geometry: PupilGeometry,
    samples: int,
    *,
    stop_m: tuple[float, float] = ON_AXIS,
    subsamples: int = SUBSAMPLES,
) -> np.ndarray:
    """Return the amplitude of a pupil as in `band_limited_pupil`, (n, n), `samples` across the diameter.

    An internal stop at `stop_m` has the outline and the hole of the pupil, but no vanes. A coarse cell has
    `subsamples` fine cells per side.
    """
    fine = fine_centres(geometry, samples, subsamples)
    filtering = filter_matrix(samples + 2 * PAD, subsamples)
    if geometry.plain:
        return _filtered_in_blocks(geometry, fine, filtering, stop_m)
    return sum(filtering[:, rows] @ (clear @ filtering.T) for rows, clear in _by_rows(geometry, fine, stop_m))


def band_limited_parts(
    geometry: PupilGeometry,
    samples: int,
    division: Division,
    *,
    stop_m: tuple[float, float] = ON_AXIS,
    subsamples: int = SUBSAMPLES,
) -> np.ndarray:
    """Return the amplitudes of the parts of a pupil, (parts, n, n); their sum is that of the pupil.

    The `division` says which parts; `geometry`, `samples`, `stop_m` and `subsamples` are as of
    `band_limited`.
    """
    fine = fine_centres(geometry, samples, subsamples)
    filtering, step = filter_matrix(samples + 2 * PAD, subsamples), float(fine[1] - fine[0])
    found = np.zeros((division.count, len(filtering), len(filtering)))
    for rows, clear in _by_rows(geometry, fine, stop_m):
        for number, columns, share in division.shares(fine[None, :], fine[rows, None], step):
            found[number] += filtering[:, rows] @ ((clear[:, columns] * share) @ filtering[:, columns].T)
    return found


def fine_centres(geometry: PupilGeometry, samples: int, subsamples: int) -> np.ndarray:
    """Coordinates along either axis [m] of a grid with `subsamples` per sample of `band_limited_pupil`.

    `geometry` and `samples` are those of the pupil.
    """
    return grid_centres((samples + 2 * PAD) * subsamples, geometry.diameter_m / samples / subsamples)


@lru_cache(maxsize=8)
def filter_matrix(total: int, subsamples: int) -> np.ndarray:
    """Low-pass along one axis of the fine grid that picks the coarse samples, (total, total · subsamples).

    `total` is the number of coarse samples, each of `subsamples` fine ones.
    """
    size = total * subsamples
    cycles = np.fft.fftfreq(size)  # per fine cell
    nyquists = np.abs(cycles) * 2 * subsamples
    ramp = np.clip((nyquists - PASS_BAND) / (STOP_BAND - PASS_BAND), 0, 1)
    half_cell = np.exp(1j * np.pi * cycles)  # a shift that centres the picked samples
    impulse = np.fft.ifft(np.cos(np.pi / 2 * ramp) ** 2 / np.sinc(cycles) * half_cell).real
    picked = np.arange(total) * subsamples + subsamples // 2 - 1
    return impulse[(picked[:, None] - np.arange(size)[None, :]) % size]


def _by_rows(
    geometry: PupilGeometry, centres_m: np.ndarray, stop_m: tuple[float, float]
) -> Iterator[tuple[slice, np.ndarray]]:
    """Clear fraction of the cells, a few rows at a time, with the rows they are."""
    step = centres_m[1] - centres_m[0]
    for first in range(0, len(centres_m), ROWS_AT_A_TIME):
        rows = slice(first, first + ROWS_AT_A_TIME)
        yield rows, clear_fraction(geometry, centres_m[None, :], centres_m[rows, None], step, stop_m)


def _filtered_in_blocks(
    geometry: PupilGeometry, fine_m: np.ndarray, filtering: np.ndarray, stop_m: tuple[float, float]
) -> np.ndarray:
    """Return the low-passed clear fraction of fine cells of a disc with, at most, a hole and vanes, (n, n).

    The centres `fine_m` of the cells along either axis are (n · cells,); `filtering`, (n, n · cells), is the
    low-pass along one axis, and `stop_m` the position of the internal stop.
    """
    n = len(filtering)
    fine, step = fine_m.reshape(n, -1), float(fine_m[1] - fine_m[0])
    reach_m = (fine.shape[1] / np.sqrt(2) + 1) * step  # of a block; edges are a cell wide
    x, y = np.meshgrid(fine.mean(1), fine.mean(1))
    at_vanes = []
    for vane in geometry.vanes:
        along, beside = vane.along_m(x, y), np.abs(vane.across_m(x, y)) < vane.width_m / 2 + reach_m
        at_vanes.append(beside & (along > -reach_m) & (along < vane.axis[1] + reach_m))
    at_circles = [  # of the pupil or of the stop
        np.abs(np.hypot(x - x0, y - y0) - diameter_m / 2) < reach_m
        for x0, y0 in {(0.0, 0.0), stop_m}
        for diameter_m in (geometry.diameter_m, geometry.obscuration_m)
    ]
    rows, columns = np.nonzero(np.logical_or.reduce([*at_circles, *at_vanes]))
    cells_x, cells_y = fine[columns][:, None, :], fine[rows][:, :, None]
    cells = outline_cover(geometry, cells_x, cells_y, step, stop_m)
    for vane, there in zip(geometry.vanes, at_vanes, strict=True):
        own = there[rows, columns]
        cells[own] *= 1 - vane.cover(cells_x[own], cells_y[own], step)
    clear = np.empty((n, fine.shape[1]) * 2)
    clear[:] = outline_cover(geometry, x, y, step, stop_m)[:, None, :, None]
    clear[rows, :, columns] = cells
    return filtering @ (clear.reshape(2 * fine_m.shape) @ filtering.T)


@lru_cache(maxsize=8)
def petals_of(geometry: PupilGeometry) -> Division:
    """Return the connected parts of the clear area of a pupil `geometry`, gaps between segments not counted.

    They are numbered anticlockwise from the one nearest to the +45° diagonal; a pupil that is not divided has
    a single one.
    """
    step = geometry.diameter_m / LABELLED
    u = grid_centres(LABELLED + 2 * NARROWEST, step)
    clear = area_weighted_pupil(_parted(geometry, step), u)
    labels, _ = scipy.ndimage.label(clear > clear.max() / 2)
    areas = np.bincount(labels.ravel())[1:]
    large = np.flatnonzero(areas > SMALLEST * areas.sum()) + 1
    centres = np.array(scipy.ndimage.center_of_mass(labels > 0, labels, large))[:, ::-1] - (len(u) - 1) / 2
    number = np.full(len(areas) + 1, -1)
    number[large[anticlockwise_from_first(centres)]] = np.arange(len(large))
    numbers = number[labels]
    # small parts and the dark have the number of the nearest petal
    nearest = scipy.ndimage.distance_transform_edt(numbers < 0, return_distances=False, return_indices=True)
    nearest_petal = numbers[tuple(nearest)]

    def index(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        row, column = (
            np.clip(np.rint((axis_m - u[0]) / step), 0, len(u) - 1).astype(int) for axis_m in (y_m, x_m)
        )
        return nearest_petal[row, column]

    return Division(index, len(large))


@lru_cache(maxsize=8)
def segments_of(geometry: PupilGeometry) -> Division:
    """Return the segments that a pupil `geometry` is drawn with, or else its petals."""
    pieces = geometry.segments
    if len(pieces) < 2:
        return petals_of(geometry)

    def index(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        return np.argmax([piece.distance_m(*piece.placement.back(x_m, y_m)) for piece in pieces], axis=0)

    return Division(index, len(pieces), partial(_segment_shares, geometry))


@lru_cache(maxsize=8)
def amplitudes_of(division: Division, geometry: PupilGeometry, samples: int) -> np.ndarray:
    """Return the band-limited amplitude of every part, (parts, n, n); their sum is that of the pupil.

    The `division` is that of `petals_of` or `segments_of` this pupil; `samples` as of
    `pupil.band_limited_pupil`.
    """
    return band_limited_parts(geometry, samples, division)


def _segment_shares(
    geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray, step_m: float
) -> Iterator[tuple[int, slice, np.ndarray]]:
    """See `Division.shares`; cells on a gap narrower than themselves belong to two segments."""
    all_covers, found = np.zeros((len(y_m), x_m.shape[1])), []
    for number, piece in enumerate(geometry.segments):
        rows, columns = piece.box(x_m, y_m, step_m)
        cover = np.zeros((len(y_m), columns.stop - columns.start))
        cover[rows] = piece.cover(x_m[:, columns], y_m[rows], step_m)
        all_covers[:, columns] += cover
        if cover.any():
            found.append((number, columns, cover))
    whole = np.where(all_covers > 0, all_covers, 1.0)
    for number, columns, cover in found:
        yield number, columns, cover / whole[:, columns]


def _parted(geometry: PupilGeometry, step_m: float) -> PupilGeometry:
    """The pupil with segments joined, and vanes that are long and wide enough to part petals."""
    vanes = []
    for vane in geometry.vanes:
        start, end = complex(*vane.start_m), complex(*vane.end_m)
        beyond = WIDEST_GAP * geometry.diameter_m * (end - start) / abs(end - start)
        start, end = start - beyond, end + beyond
        width_m = max(vane.width_m, NARROWEST * step_m)
        vanes.append(Vane((start.real, start.imag), (end.real, end.imag), width_m))
    aperture = tuple(part.gapless for part in geometry.aperture)
    return replace(geometry, vanes=tuple(vanes), aperture=aperture)


# -- how it changes ------------------------------------------------------------------------------


def pupil_edges(
    geometry: PupilGeometry,
    samples: int,
    subsamples: int,
    stop_m: tuple[float, float],
    division: Division | None = None,
) -> Edges:
    """Return what gives the derivatives of a pupil; see `DrawnEdges` for the parameters.

    Only what lies near an edge changes. A disc with a hole and vanes has few edges, which are followed one by
    one; any other pupil is drawn twice, which takes 6 to 28 times as long and errs 2 to 5 times as much where
    a stop moves.
    """
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
    """Edges of a pupil with an internal stop at `stop_m`, as `band_limited` draws them.

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
