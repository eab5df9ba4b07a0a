"""The telescope pupil as a drawing, in metres: what light passes, and what stands in its way.

It is drawn by cells: x and y are the coordinates of their middles, `step` is their side [m], and the covered
fraction of a cell is linear in the distance of its middle to an edge.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.conventions.pupil_parts import AmplitudeMap, Circle, Part, Placement

ON_AXIS = (0.0, 0.0)
BEYOND_RIM = 1.005  # of the diameter: as far as parts may reach


@dataclass(frozen=True)
class Vane:
    """A straight bar of the spider from `start_m` to `end_m` (x, y), of full width `width_m` [m]."""

    start_m: tuple[float, float]
    end_m: tuple[float, float]
    width_m: float

    def placed(self, placement: Placement) -> "Vane":
        """Return the vane carried to a `placement`."""
        (x0, y0), (x1, y1) = placement.forth(*self.start_m), placement.forth(*self.end_m)
        return Vane((float(x0), float(y0)), (float(x1), float(y1)), self.width_m)

    @property
    def axis(self) -> tuple[np.ndarray, float, np.ndarray]:
        """Where it starts, its length, and its direction."""
        start, end = np.array(self.start_m), np.array(self.end_m)
        length = float(np.hypot(*(end - start)))
        return start, length, (end - start) / length

    def along_m(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the distance of points from its start, along it."""
        start, _, direction = self.axis
        return (x - start[0]) * direction[0] + (y - start[1]) * direction[1]

    def across_m(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the distance of points to the left of its axis."""
        start, _, direction = self.axis
        return (y - start[1]) * direction[0] - (x - start[0]) * direction[1]

    def cover(self, x: np.ndarray, y: np.ndarray, step: float) -> np.ndarray:
        """Return the fraction of each cell that it covers."""
        along, across, half = self.along_m(x, y), self.across_m(x, y), self.width_m / 2
        width = inside((across + half) / step) + inside((half - across) / step) - 1
        return np.clip(width, 0, 1) * inside(along / step) * inside((self.axis[1] - along) / step)


@dataclass(frozen=True)
class PupilGeometry:
    """The pupil: an aperture, less a central hole, obstructions and vanes.

    Raises `ValueError` if these contradict each other.
    """

    diameter_m: float  # of the disc that contains it, on which Zernike polynomials have unit RMS
    obscuration_m: float = 0.0  # diameter of a round hole about the axis
    vanes: tuple[Vane, ...] = ()
    aperture: tuple[Part, ...] = ()  # what light passes, without overlaps; empty: the disc of the diameter
    obstructions: tuple[Part, ...] = ()  # what else stands in the way

    def __post_init__(self) -> None:
        rim_m = self.diameter_m / 2
        if not 0 <= self.obscuration_m < self.diameter_m:
            raise ValueError(
                f"the obscuration, {self.obscuration_m:g} m, should be smaller than the diameter, "
                f"{self.diameter_m:g} m"
            )
        for number, vane in enumerate(self.vanes, start=1):
            if vane.start_m == vane.end_m:
                raise ValueError(f"vane {number} starts where it ends, at {vane.start_m}")
            if not 0 < vane.width_m < self.diameter_m:
                raise ValueError(
                    f"vane {number}: its width, {vane.width_m:g} m, should be positive and small"
                )
            start, end = complex(*vane.start_m), complex(*vane.end_m)
            along = end - start
            share = min(max(-(start * along.conjugate()).real / abs(along) ** 2, 0.0), 1.0)
            if abs(start + share * along) >= rim_m + vane.width_m / 2:
                raise ValueError(f"vane {number} lies outside the diameter, {self.diameter_m:g} m")
        if self.map and len(self.aperture) > 1:
            raise ValueError("a map is the whole aperture; leave the other parts out")
        for part in self.aperture:
            if part.reach_m > BEYOND_RIM * rim_m:
                raise ValueError(
                    f"the {part.title} reaches {part.reach_m:.4g} m from the axis, beyond half the diameter, "
                    f"{rim_m:g} m"
                )

    @property
    def plain(self) -> bool:
        """Whether it is a disc with a hole and vanes only."""
        return not self.aperture and not self.obstructions

    @property
    def vane_width_m(self) -> float:
        """Mean width of the vanes [m]; 0 without any."""
        return sum(vane.width_m for vane in self.vanes) / len(self.vanes) if self.vanes else 0.0

    @property
    def map(self) -> AmplitudeMap | None:
        """The aperture, if it is a map."""
        return next((part for part in self.aperture if isinstance(part, AmplitudeMap)), None)

    @property
    def segments(self) -> tuple[Part, ...]:
        """The drawn pieces of the aperture."""
        return tuple(piece for part in self.aperture for piece in part.pieces)


def placed(geometry: PupilGeometry, placement: Placement) -> PupilGeometry:
    """Return the pupil `geometry` carried to a `placement`."""
    carried = replace(
        geometry,
        vanes=tuple(vane.placed(placement) for vane in geometry.vanes),
        aperture=tuple(part.placed(placement) for part in geometry.aperture),
        obstructions=tuple(part.placed(placement) for part in geometry.obstructions),
    )
    if placement.shift_m == (0.0, 0.0):
        return carried
    # what lies about the axis is moved as well, so it becomes a part
    moved = Placement(shift_m=placement.shift_m)
    hole = (Circle(geometry.obscuration_m).placed(moved),) if geometry.obscuration_m else ()
    return replace(
        carried,
        obscuration_m=0.0,
        aperture=carried.aperture or (Circle(geometry.diameter_m).placed(moved),),
        obstructions=(*carried.obstructions, *hole),
    )


def turned(geometry: PupilGeometry, angle_deg: float) -> PupilGeometry:
    """Return the pupil `geometry` turned anticlockwise about the axis by `angle_deg`."""
    return placed(geometry, Placement(rotation_deg=angle_deg))


def with_sizes(
    geometry: PupilGeometry, *, obscuration_m: float | None = None, vane_width_m: float | None = None
) -> PupilGeometry:
    """Return the pupil `geometry` with a hole of `obscuration_m` and vanes `vane_width_m` wide on average.

    What is not given stays; all vanes are wider in the same ratio, which a pupil without vanes has not.
    """
    given = vane_width_m is not None and geometry.vane_width_m > 0
    wider = (vane_width_m or 0.0) / geometry.vane_width_m if given else 1.0
    return replace(
        geometry,
        obscuration_m=geometry.obscuration_m if obscuration_m is None else obscuration_m,
        vanes=tuple(replace(vane, width_m=wider * vane.width_m) for vane in geometry.vanes),
    )


def inside(distance_cells: np.ndarray) -> np.ndarray:
    """Return the covered fraction of a cell whose middle lies `distance_cells` inside an edge."""
    return np.clip(distance_cells + 0.5, 0.0, 1.0)


def clear_fraction(
    geometry: PupilGeometry,
    x: np.ndarray,
    y: np.ndarray,
    step: float,
    stop_m: tuple[float, float] = ON_AXIS,
) -> np.ndarray:
    """Return the fraction of each cell that passes light, (rows, columns).

    `x` is (1, columns) and `y` (rows, 1). An internal stop at `stop_m` has the outline and the hole of the
    pupil, but no vanes.
    """
    clear = outline_cover(geometry, x, y, step, stop_m)
    for part in geometry.obstructions:
        clear *= 1 - parts_cover([part], x, y, step)
    for vane in geometry.vanes:  # most cells lie far from it
        rows, columns = np.nonzero(np.abs(vane.across_m(x, y)) < vane.width_m / 2 + step)
        clear[rows, columns] *= 1 - vane.cover(x[0, columns], y[rows, 0], step)
    return clear


def outline_cover(
    geometry: PupilGeometry, x: np.ndarray, y: np.ndarray, step: float, stop_m: tuple[float, float]
) -> np.ndarray:
    """Return the fraction of each cell inside the outlines and outside the holes of pupil and stop.

    `x` and `y` are as of `clear_fraction` where an aperture is drawn, and broadcast otherwise.
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
    """Return the fraction of each cell that `parts`, which do not overlap, cover; see `clear_fraction`."""
    covered = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    for piece in (piece for part in parts for piece in part.pieces):
        rows, columns = piece.box(x, y, step)
        covered[rows, columns] += piece.cover(x[:, columns], y[rows], step)
    return covered
