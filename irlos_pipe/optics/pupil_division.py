"""How a pupil is divided: into petals, which vanes part, and into the segments it is drawn with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import scipy

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane
from irlos_pipe.conventions.pupil_parts import anticlockwise_from_first
from irlos_pipe.optics.pupil import Division, area_weighted_pupil, band_limited_parts, grid_centres

LABELLED = 1024  # cells across the diameter of the drawing in which connected parts are looked for
WIDEST_GAP = 0.02  # of the diameter: a vane that ends this close to the rim parts petals all the same
NARROWEST = 3  # cells: thinner vanes are drawn that wide there
SMALLEST = 0.01  # of the clear area: what is smaller belongs to the adjacent petal


class Petals:
    """Connected parts of the clear area of a pupil, gaps between segments not counted.

    They are numbered anticlockwise from the one nearest to the +45° diagonal.
    """

    def __init__(self, geometry: PupilGeometry):
        self._step = geometry.diameter_m / LABELLED
        self._u = grid_centres(LABELLED + 2 * NARROWEST, self._step)
        clear = area_weighted_pupil(_parted(geometry, self._step), self._u)
        labels, _ = scipy.ndimage.label(clear > clear.max() / 2)
        areas = np.bincount(labels.ravel())[1:]
        large = np.flatnonzero(areas > SMALLEST * areas.sum()) + 1
        centres = (
            np.array(scipy.ndimage.center_of_mass(labels > 0, labels, large))[:, ::-1]
            - (len(self._u) - 1) / 2
        )
        number = np.full(len(areas) + 1, -1)
        number[large[anticlockwise_from_first(centres)]] = np.arange(len(large))
        self.count = len(large)
        self._index = _grown(number[labels])

    def index(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Return the number of the petal at, or nearest to, the points (`x_m`, `y_m`)."""
        row, column = (self._cell(axis) for axis in (y_m, x_m))
        return self._index[row, column]

    def _cell(self, axis_m: np.ndarray) -> np.ndarray:
        return np.clip(np.rint((axis_m - self._u[0]) / self._step), 0, len(self._u) - 1).astype(int)


@lru_cache(maxsize=8)
def petals_of(geometry: PupilGeometry) -> Division:
    """Return the petals of a pupil `geometry`; one that is not divided has a single one."""
    petals = Petals(geometry)
    return Division(petals.index, petals.count)


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
    vanes = tuple(
        _lengthened(v, WIDEST_GAP * geometry.diameter_m, NARROWEST * step_m) for v in geometry.vanes
    )
    return replace(geometry, vanes=vanes, aperture=tuple(part.gapless for part in geometry.aperture))


def _lengthened(vane: Vane, by_m: float, least_width_m: float) -> Vane:
    start, end = complex(*vane.start_m), complex(*vane.end_m)
    step = by_m * (end - start) / abs(end - start)
    start, end = start - step, end + step
    return Vane((start.real, start.imag), (end.real, end.imag), max(vane.width_m, least_width_m))


def _grown(index: np.ndarray) -> np.ndarray:
    """`index` with the nearest number in place of negative ones."""
    nearest = scipy.ndimage.distance_transform_edt(index < 0, return_distances=False, return_indices=True)
    return index[tuple(nearest)]
