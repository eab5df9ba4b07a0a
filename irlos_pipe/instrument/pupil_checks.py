"""Whether a drawn pupil can be one: its parts do not overlap, it passes light, and it reaches the rim."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane
from irlos_pipe.conventions.pupil_parts import Part

CELLS = 256  # across the diameter: a hole of a hundredth of it, as of an aperture mask, has five
# Neighbours whose coordinates are rounded to millimetres overlap by less; where they do, the amplitude is 2.
MOST_OVERLAP = 1e-3  # of the aperture's area
LEAST_LIGHT = 1e-3  # of the disc's; aperture masks pass some per cents
# A map of half the scale, or a diameter in other units, ends before this; stops and aperture masks do not.
# Of a Zernike polynomial of order n, a pupil that ends at x of the rim sees x^n: 4 % of one of order 8.
LEAST_REACH = 2 / 3  # of half the diameter


@lru_cache(maxsize=16)
def require_usable(geometry: PupilGeometry) -> None:
    """Check what light the pupil `geometry` passes, on a grid.

    Raises
    ------
    ValueError
        Saying in one line what is wrong and what to correct.
    """
    rim_m = geometry.diameter_m / 2
    step_m = geometry.diameter_m / CELLS
    axis_m = (np.arange(CELLS + 2) - (CELLS + 1) / 2) * step_m
    open_to_light, overlap = _aperture(geometry, axis_m, step_m)
    if overlap > MOST_OVERLAP:
        raise ValueError(
            f"the parts of the aperture overlap: {overlap:.2g} of its area is covered twice; draw it once"
        )
    # edges that meet leave a part of a cell clear, which is no light
    lit = open_to_light * _left(geometry, axis_m, step_m) > open_to_light.max() / 2
    light = lit.sum() * step_m**2 / (np.pi * rim_m**2)
    if light < LEAST_LIGHT:
        passed = f"only {light:.1g} of the light" if lit.any() else "no light"
        raise ValueError(f"it lets {passed} on its disc pass; compare aperture, hole, obstructions and vanes")
    reach_m = _radius_m(axis_m)[lit].max()
    if reach_m < LEAST_REACH * rim_m:
        raise ValueError(
            f"what passes light ends {reach_m:.3g} m from the axis, before {LEAST_REACH:.2g} of half the "
            f"diameter, {rim_m:g} m; correct pupil_diameter_m, or the scale of what is drawn"
        )


def _aperture(geometry: PupilGeometry, axis_m: np.ndarray, step_m: float) -> tuple[np.ndarray, float]:
    """The fraction of each cell that the aperture covers, (rows, columns), and of its area covered twice."""
    if not geometry.aperture:
        return np.clip((geometry.diameter_m / 2 - _radius_m(axis_m)) / step_m + 0.5, 0, 1), 0.0
    if geometry.map:
        return np.clip(geometry.map.cover(axis_m[None, :], axis_m[:, None], step_m), 0, 1), 0.0
    cover, pieces = np.zeros((len(axis_m),) * 2), np.zeros((len(axis_m),) * 2, int)
    for piece in geometry.segments:
        box, distance_m = _distance_m(piece, axis_m, step_m)
        cover[box] += np.clip(distance_m / step_m + 0.5, 0, 1)
        pieces[box] += distance_m > 1e-6 * step_m
    return np.minimum(cover, 1), _ratio(pieces > 1, pieces > 0)


def _left(geometry: PupilGeometry, axis_m: np.ndarray, step_m: float) -> np.ndarray:
    """The fraction of each cell that hole, obstructions and vanes leave, (rows, columns)."""
    left = np.clip((_radius_m(axis_m) - geometry.obscuration_m / 2) / step_m + 0.5, 0, 1)
    if not geometry.obscuration_m:
        left[:] = 1.0
    for piece in (piece for part in geometry.obstructions for piece in part.pieces):
        box, distance_m = _distance_m(piece, axis_m, step_m)
        left[box] *= 1 - np.clip(distance_m / step_m + 0.5, 0, 1)
    for vane in geometry.vanes:
        left *= ~_behind(vane, axis_m)
    return left


def _distance_m(piece: Part, axis_m: np.ndarray, step_m: float) -> tuple[tuple[slice, slice], np.ndarray]:
    """Rows and columns that a piece may touch, and how far inside its edge their cells lie [m]."""
    reach_m = piece.radius_m + step_m
    columns, rows = (
        slice(*np.searchsorted(axis_m, [centre - reach_m, centre + reach_m]))
        for centre in piece.placement.shift_m
    )
    places = piece.placement.back(axis_m[None, columns], axis_m[rows, None])
    return (rows, columns), piece.distance_m(*places)


def _behind(vane: Vane, axis_m: np.ndarray) -> np.ndarray:
    """Whether the middle of each cell lies behind a vane, (rows, columns)."""
    start, end = complex(*vane.start_m), complex(*vane.end_m)
    direction = (end - start) / abs(end - start)
    place = (axis_m[None, :] + 1j * axis_m[:, None] - start) * direction.conjugate()
    return (np.abs(place.imag) < vane.width_m / 2) & (place.real > 0) & (place.real < abs(end - start))


def _radius_m(axis_m: np.ndarray) -> np.ndarray:
    return np.hypot(axis_m[None, :], axis_m[:, None])


def _ratio(part: np.ndarray, whole: np.ndarray) -> float:
    return int(np.count_nonzero(part)) / max(int(np.count_nonzero(whole)), 1)
