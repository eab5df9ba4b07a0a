"""Petals and segments of the simulated pupil: which part of it a point belongs to."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy import ndimage

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane
from irlos_pipe.conventions.pupil_parts import anticlockwise_from_first
from irlos_pipe.simulate.aperture import centres, passed

POINTS = 800  # across the diameter
LONGER = 0.02  # of the diameter: vanes are drawn longer, so that a slit at the rim joins no petals
LEAST_SHARE = 0.01  # of the clear points: fewer make no petal


def petal_count(geometry: PupilGeometry) -> int:
    """Return into how many petals the vanes divide the pupil `geometry`."""
    return int(_petal_map(geometry).max()) + 1


def petal_index(geometry: PupilGeometry, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return the number of the petal at, or nearest to, every point.

    Petals are the connected parts of the clear pupil, segments taken as one mirror, counted anticlockwise
    from the one nearest to the +45° diagonal.

    Parameters
    ----------
    geometry : PupilGeometry
    x_m, y_m : ndarray, shapes that broadcast
        Points in the pupil.
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
    order = anticlockwise_from_first(np.stack([columns - middle, rows - middle], axis=1))
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
