"""The telescope pupil sampled by area."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
import scipy

from irlos_pipe.conventions.pupil_drawing import ON_AXIS, PupilGeometry, Vane, clear_fraction, outline_cover
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
        for number in np.unique(index).tolist():
            inside = index == number
            columns = np.flatnonzero(inside.any(0))
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
