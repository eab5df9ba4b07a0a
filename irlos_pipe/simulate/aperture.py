"""The pupil as an object: where light passes, and to which petal or segment a point belongs.

Points are counted; the edges of the drawing are not used.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, singledispatch

import numpy as np
from scipy import ndimage

from irlos_pipe.conventions import pupil_parts
from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane

FINEST_CELL_M = 0.002  # cell of the brute-force drawing: a twentieth of a vane
EDGE_CELL_M = 0.001  # its cell at the edges of drawn parts: a third of the gap between two segments
FINER = 4  # a map is resampled so many times finer along each axis before it is interpolated linearly
DARK_RIM = 8  # samples of the dark frame round a map, so that its spectrum does not wrap round
POINTS = 800  # of the map of petals, across the diameter
LONGER = 0.02  # part of the diameter by which vanes are drawn longer: a slit at the rim joins no petals
LEAST_SHARE = 0.01  # part of the clear points that a petal has at least


def centres(count: int, step: float) -> np.ndarray:
    """Return the positions of `count` points `step` apart, symmetric about 0."""
    return (np.arange(count) - (count - 1) / 2) * step


def clear_fraction(
    geometry: PupilGeometry, u_m: np.ndarray, stop_m: tuple[float, float] | None = None
) -> np.ndarray:
    """Return the mean amplitude in every cell of a square grid, by counting points on a much finer one.

    The cells of the pupil `geometry` have their centres at `u_m` (n,) along x and along y; the result is (n,
    n), row = y. An internal stop at `stop_m` (x, y) has the outline and the central hole but no vanes.
    """
    step = float(u_m[1] - u_m[0])
    found = np.array([_row(geometry, u_m, y, step, stop_m, FINEST_CELL_M) for y in u_m])
    if geometry.plain or geometry.map:
        return found
    edges = ndimage.maximum_filter(found, 3) > ndimage.minimum_filter(found, 3)
    for row in np.flatnonzero(edges.any(axis=1)):
        cells = edges[row]
        found[row, cells] = _row(geometry, u_m[cells], u_m[row], step, stop_m, EDGE_CELL_M, skewed=True)
    return found


def _row(
    geometry: PupilGeometry,
    x_m: np.ndarray,
    y_m: float,
    step: float,
    stop_m: tuple[float, float] | None,
    finest_m: float,
    *,
    skewed: bool = False,
) -> np.ndarray:
    """Mean amplitude in cells of a side of `step` about (`x_m`, `y_m`), from points `finest_m` apart.

    Rows and columns of `skewed` points are slightly inclined: an edge along a row would otherwise be
    misplaced by as much as half their distance.
    """
    points = max(2, int(np.ceil(step / finest_m)))
    inner = centres(points, step / points)
    x, y = (x_m[:, None] + inner).ravel()[None, :], (y_m + inner)[:, None]
    if skewed:
        x, y = x + inner[:, None] / points, y + np.tile(inner, len(x_m)) / points
    clear = passed(geometry, x, y)
    if stop_m is not None:
        outline = [part.outline for part in geometry.aperture]
        clear = clear * _in_aperture(geometry, outline, x - stop_m[0], y - stop_m[1])
    return clear.reshape(points, len(x_m), points).mean(axis=(0, 2))


def passed(geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return the amplitude that passes the pupil `geometry` at points, (rows, columns).

    Their coordinates `x_m` and `y_m`, (1, columns) and (rows, 1), or (rows, columns), ascend along rows and
    columns [m].
    """
    clear = _in_aperture(geometry, geometry.aperture, x_m, y_m)
    for part in geometry.obstructions:
        clear = clear * (1 - _in_parts([part], x_m, y_m))
    for vane in geometry.vanes:
        (x0, y0), (x1, y1) = vane.start_m, vane.end_m
        length = np.hypot(x1 - x0, y1 - y0)
        cos, sin = (x1 - x0) / length, (y1 - y0) / length
        along = (x_m - x0) * cos + (y_m - y0) * sin
        across = (y_m - y0) * cos - (x_m - x0) * sin
        behind = (along >= 0) & (along <= length) & (np.abs(across) <= vane.width_m / 2)
        clear = clear * ~behind
    return clear


def _in_aperture(
    geometry: PupilGeometry, aperture: Sequence[pupil_parts.Part], x_m: np.ndarray, y_m: np.ndarray
) -> np.ndarray:
    """Amplitude inside the `aperture`, or the disc where none is drawn, and outside the central hole."""
    radius2 = x_m**2 + y_m**2
    open_to_light = radius2 >= geometry.obscuration_m**2 / 4
    if not aperture:
        return open_to_light & (radius2 <= geometry.diameter_m**2 / 4)
    return open_to_light * _in_parts(aperture, x_m, y_m)


def _in_parts(parts: Sequence[pupil_parts.Part], x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    inside = np.zeros(np.broadcast_shapes(x_m.shape, y_m.shape))
    for piece in (piece for part in parts for piece in part.pieces):
        (x0, y0), reach_m = piece.placement.shift_m, piece.radius_m + FINEST_CELL_M
        rows = slice(*np.searchsorted(y_m[:, 0], [y0 - reach_m, y0 + reach_m]))
        columns = slice(*np.searchsorted(x_m[0], [x0 - reach_m, x0 + reach_m]))
        if rows.stop > rows.start and columns.stop > columns.start:
            near_x = x_m[rows if len(x_m) > 1 else slice(None), columns]
            near_y = y_m[rows, columns if y_m.shape[1] > 1 else slice(None)]
            inside[rows, columns] += _inside(piece, *piece.placement.back(near_x, near_y))
    return inside


@singledispatch
def _inside(piece: pupil_parts.Part, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Amplitude of a piece at points about its own origin."""
    raise NotImplementedError(f"the simulator does not know the pupil part {type(piece).__name__}")


@_inside.register
def _(piece: pupil_parts.Circle, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    return x_m**2 + y_m**2 <= piece.diameter_m**2 / 4


@_inside.register
def _(piece: pupil_parts.Hexagon, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    strips = [np.abs(x_m * np.cos(a) + y_m * np.sin(a)) for a in np.deg2rad([30.0, 90.0, 150.0])]
    return np.maximum.reduce(np.broadcast_arrays(*strips)) <= piece.flat_to_flat_m / 2


@_inside.register
def _(piece: pupil_parts.Polygon, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Where the closed line winds round the point, counted by its crossings of the ray towards +x."""
    turns = np.zeros(np.broadcast_shapes(x_m.shape, y_m.shape), dtype=int)
    for (x0, y0), (x1, y1) in zip(piece.corners_m, np.roll(piece.corners_m, -1, axis=0), strict=True):
        left = (x1 - x0) * (y_m - y0) - (x_m - x0) * (y1 - y0)
        turns += (y0 <= y_m) & (y_m < y1) & (left > 0)
        turns -= (y1 <= y_m) & (y_m < y0) & (left < 0)
    return turns != 0


@_inside.register
def _(piece: pupil_parts.AmplitudeMap, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    finer = _finer(piece.samples)
    x_m, y_m = np.broadcast_arrays(x_m, y_m)
    origin = ((len(piece.samples.values) - 1) / 2 + DARK_RIM) * FINER
    places = np.stack([y_m, x_m]) / piece.step_m * FINER + origin
    return ndimage.map_coordinates(finer, places, order=1)


@lru_cache(maxsize=4)
def _finer(samples: pupil_parts.Samples) -> np.ndarray:
    """Map in a dark frame with `FINER` samples in place of one, of the same spectrum."""
    padded = np.pad(samples.values, DARK_RIM)
    size, cycles = len(padded), np.fft.fftfreq(len(padded))
    at = np.arange(FINER * size) / FINER
    # the highest frequency of an even number of samples counts half on either side
    waves = np.exp(2j * np.pi * np.outer(at, cycles * size) / size)
    to_finer = (waves @ np.fft.fft(np.eye(size)) / size).real
    return to_finer @ padded @ to_finer.T


def petal_count(geometry: PupilGeometry) -> int:
    """Return into how many petals the vanes divide the pupil `geometry`."""
    return int(_petal_map(geometry).max()) + 1


def petal_index(geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return the number of the petal of the pupil `geometry` at, or nearest to, points (`x_m`, `y_m`).

    Petals are the connected parts of the clear pupil, segments taken as one mirror, counted anticlockwise
    from the one nearest to the +45° diagonal.
    """
    numbers = _petal_map(geometry)
    step, middle = geometry.diameter_m / POINTS, (len(numbers) - 1) / 2
    row, column = (
        np.clip(np.floor(axis / step + middle + 0.5), 0, len(numbers) - 1).astype(int) for axis in (y_m, x_m)
    )
    return numbers[row, column]


def segment_count(geometry: PupilGeometry) -> int:
    """Return the number of segments that the pupil `geometry` is drawn with, or else of its petals."""
    return len(geometry.segments) if len(geometry.segments) > 1 else petal_count(geometry)


def segment_index(geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return the number of the segment at, or nearest to, the points; parameters as of `petal_index`."""
    if len(geometry.segments) < 2:
        return petal_index(geometry, x_m, y_m)
    best = np.full(np.broadcast_shapes(x_m.shape, y_m.shape), -np.inf)
    index = np.zeros(best.shape, dtype=int)
    for number, piece in enumerate(geometry.segments):
        inside_m = piece.distance_m(*piece.placement.back(x_m, y_m))
        index, best = np.where(inside_m > best, number, index), np.maximum(best, inside_m)
    return index


@lru_cache(maxsize=8)
def _petal_map(geometry: PupilGeometry) -> np.ndarray:
    """Number of the petal at, or nearest to, each point of a grid."""
    step = geometry.diameter_m / POINTS
    drawn = replace(
        geometry,
        aperture=tuple(part.gapless for part in geometry.aperture),
        vanes=tuple(_drawn_clearly(vane, LONGER * geometry.diameter_m, 3 * step) for vane in geometry.vanes),
    )
    u = centres(POINTS + 4, step)
    light = passed(drawn, u[None, :], u[:, None])
    labels, found = ndimage.label(light > light.max() / 2)
    lit = labels > 0
    sizes = np.array([np.count_nonzero(labels == label) for label in range(1, found + 1)])
    petals = 1 + np.flatnonzero(sizes > LEAST_SHARE * lit.sum())
    rows, columns = np.array(ndimage.center_of_mass(lit, labels, petals)).T
    middle = (len(u) - 1) / 2
    order = pupil_parts.anticlockwise_from_first(np.stack([columns - middle, rows - middle], axis=1))
    numbers = np.full(labels.shape, -1)
    for number, place in enumerate(order):
        numbers[labels == petals[place]] = number
    nearest = ndimage.distance_transform_edt(numbers < 0, return_distances=False, return_indices=True)
    return numbers[tuple(nearest)]


def _drawn_clearly(vane: Vane, longer_m: float, least_width_m: float) -> Vane:
    (x0, y0), (x1, y1) = vane.start_m, vane.end_m
    share = longer_m / np.hypot(x1 - x0, y1 - y0)
    dx, dy = share * (x1 - x0), share * (y1 - y0)
    return Vane((x0 - dx, y0 - dy), (x1 + dx, y1 + dy), max(vane.width_m, least_width_m))
