"""Parts that pupils are drawn with, each known by the distance to its edge.

A part is stated about its own origin and carried to its place by its `Placement`. Another part is another
class here, and a rule in `irlos_pipe.simulate.aperture`, which draws without these distances.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
import scipy

Flip = Literal["none", "x", "y"]
FIRST_DEG = 45.0  # parts are counted anticlockwise from the one nearest to this direction
SPLINE_MARGIN = 8  # samples of darkness round a map, in which the spline dies out
CLOSED_GAPS = 0.03  # of the width of a map: narrower gaps between its parts belong to its outline


@dataclass(frozen=True)
class Placement:
    """Mirrored (y changes its sign) or not, then turned anticlockwise about the axis, then moved."""

    rotation_deg: float = 0.0
    mirrored: bool = False
    shift_m: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(cls, rotation_deg: float, flip: Flip, shift_m: tuple[float, float]) -> Placement:
        """Return a placement whose `flip` exchanges left and right ("x"), up and down ("y") or nothing.

        `rotation_deg` and `shift_m` are as of the class.
        """
        # x changing its sign is y doing so and half a turn
        return cls(rotation_deg + 180.0 * (flip == "x"), flip != "none", shift_m)

    def then(self, outer: Placement) -> Placement:
        """Return the placement `outer` of what is placed by this one."""
        sense = -1 if outer.mirrored else 1
        x, y = outer.forth(*self.shift_m)
        return Placement(
            outer.rotation_deg + sense * self.rotation_deg,
            self.mirrored != outer.mirrored,
            (float(x), float(y)),
        )

    def forth(self, x_m, y_m):
        """Return where points (`x_m`, `y_m`) of the part as drawn come to lie."""
        if self == UNMOVED:
            return x_m, y_m
        cos, sin = self._cos_sin
        y_m = -y_m if self.mirrored else y_m
        return cos * x_m - sin * y_m + self.shift_m[0], sin * x_m + cos * y_m + self.shift_m[1]

    def back(self, x_m, y_m):
        """Return where points (`x_m`, `y_m`) of the placed part lie on the part as drawn."""
        if self == UNMOVED:
            return x_m, y_m
        cos, sin = self._cos_sin
        x_m, y_m = x_m - self.shift_m[0], y_m - self.shift_m[1]
        x_m, y_m = cos * x_m + sin * y_m, cos * y_m - sin * x_m
        return x_m, (-y_m if self.mirrored else y_m)

    @property
    def _cos_sin(self) -> tuple[float, float]:
        turn = np.deg2rad(self.rotation_deg)
        return float(np.cos(turn)), float(np.sin(turn))


UNMOVED = Placement()


@dataclass(frozen=True)
class Part:
    """A shape in the pupil."""

    placement: Placement = field(default=UNMOVED, kw_only=True)

    def placed(self, placement: Placement) -> Part:
        """Return the part carried to a further `placement`."""
        return replace(self, placement=self.placement.then(placement))

    title: ClassVar[str]  # in profiles and messages

    @property
    def pieces(self) -> tuple[Part, ...]:
        """The connected parts of which it consists."""
        return (self,)

    @property
    def gapless(self) -> Part:
        """The part with the gaps between its pieces closed."""
        return self

    @property
    def outline(self) -> Part:
        """What a stop of the same outline passes."""
        return self.gapless

    @property
    def radius_m(self) -> float:
        """Of the circle about its own origin that contains it [m]."""
        return float(np.hypot(*self.rim_m).max())

    @property
    def reach_m(self) -> float:
        """Largest distance of its edge from the optical axis [m]."""
        return max(float(np.hypot(*piece.placement.forth(*piece.rim_m)).max()) for piece in self.pieces)

    @property
    def rim_m(self) -> np.ndarray:
        """Points of its edge about its own origin, the farthest among them, (2, points) [m]."""
        raise NotImplementedError

    def cover(self, x_m: np.ndarray, y_m: np.ndarray, step_m: float) -> np.ndarray:
        """Return the fraction that it covers of cells of side `step_m` about (`x_m`, `y_m`), (...)."""
        distance_m = self.distance_m(*self.placement.back(x_m, y_m))
        return np.clip(distance_m / step_m + 0.5, 0.0, 1.0)

    def distance_m(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Return how far points (`x_m`, `y_m`) about its own origin lie inside its edge; negative outside."""
        raise NotImplementedError

    def box(self, x_m: np.ndarray, y_m: np.ndarray, step_m: float) -> tuple[slice, slice]:
        """Return the rows and columns of cells of side `step_m` that a connected part may touch.

        `x_m` is the row, (1, columns), and `y_m` the column, (rows, 1), of their middles.
        """
        reach_m = self.radius_m + step_m
        columns, rows = (
            slice(*np.searchsorted(axis_m.ravel(), [centre - reach_m, centre + reach_m]))
            for axis_m, centre in zip((x_m, y_m), self.placement.shift_m, strict=True)
        )
        return rows, columns


@dataclass(frozen=True)
class Circle(Part):
    """A disc of `diameter_m`."""

    title = "circle"
    diameter_m: float

    def __post_init__(self) -> None:
        _require(self.diameter_m > 0, "circle: diameter_m", self.diameter_m, "be positive")

    @property
    def rim_m(self) -> np.ndarray:
        """See `Part.rim_m`: a point per degree."""
        return self.diameter_m / 2 * _directions(np.arange(360.0)).T

    def distance_m(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        return self.diameter_m / 2 - np.hypot(x_m, y_m)


@dataclass(frozen=True)
class Polygon(Part):
    """The inside of a closed line through `corners_m`, (x, y) each, that does not cross itself."""

    title = "polygon"
    corners_m: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        _require(len(self.corners_m) >= 3, "polygon: corners_m", self.corners_m, "have three corners or more")
        x, y = np.array(self.corners_m).T
        area = np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2
        _require(area != 0, "polygon: corners_m", self.corners_m, "enclose an area")

    @property
    def rim_m(self) -> np.ndarray:
        return np.array(self.corners_m, float).T

    def distance_m(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """See `Part.distance_m`: that to the nearest side; a ray crosses the sides an odd number of times."""
        nearest2, inside = np.inf, np.False_
        for (x0, y0), (x1, y1) in zip(self.corners_m, np.roll(self.corners_m, -1, axis=0), strict=True):
            along_x, along_y, u, v = x1 - x0, y1 - y0, x_m - x0, y_m - y0
            length2 = along_x**2 + along_y**2
            if length2 == 0:
                continue
            share = np.clip((u * along_x + v * along_y) / length2, 0, 1)
            nearest2 = np.minimum(nearest2, (u - share * along_x) ** 2 + (v - share * along_y) ** 2)
            spans = (y0 > y_m) != (y1 > y_m)
            inside = inside ^ (spans & ((u * along_y - v * along_x) * np.sign(along_y) < 0))
        return np.sqrt(nearest2) * np.where(inside, 1, -1)


@dataclass(frozen=True)
class Hexagon(Part):
    """A regular hexagon of `flat_to_flat_m` with a side at the top."""

    title = "hexagon"
    flat_to_flat_m: float

    @property
    def rim_m(self) -> np.ndarray:
        return self.flat_to_flat_m / np.sqrt(3) * _directions(np.arange(6) * 60.0).T

    def distance_m(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """See `Part.distance_m`; beyond a corner to the lines of its sides."""
        beside, above = np.abs(x_m), np.abs(y_m)
        return self.flat_to_flat_m / 2 - np.maximum(above, np.sqrt(0.75) * beside + above / 2)


@dataclass(frozen=True)
class Hexagons(Part):
    """Hexagonal segments in rings about a central one."""

    title = "hexagons"
    # flat_to_flat_m, gap_m: width of a segment between opposite sides, and of the gap between neighbours;
    # segments have a side at the top
    flat_to_flat_m: float
    gap_m: float
    rings: int  # round the central segment
    # segments that are not there. The central one is 0; every ring is counted on from the one inside it,
    # anticlockwise from the segment nearest to the +45° diagonal of the pupil as drawn.
    missing: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        _require(self.flat_to_flat_m > 0, "hexagons: flat_to_flat_m", self.flat_to_flat_m, "be positive")
        _require(self.gap_m >= 0, "hexagons: gap_m", self.gap_m, "not be negative")
        _require(0 <= self.rings <= 50, "hexagons: rings", self.rings, "lie between 0 and 50")
        last = 3 * self.rings * (self.rings + 1)
        known = all(0 <= number <= last for number in self.missing)
        _require(known, "hexagons: missing", list(self.missing), f"be numbers from 0 to {last}")
        _require(len({*self.missing}) <= last, "hexagons: missing", list(self.missing), "leave a segment")

    @property
    def centres_m(self) -> np.ndarray:
        """Centres of all segments about the own origin, missing ones too, (segments, 2) [m]."""
        pitch_m, found = self.flat_to_flat_m + self.gap_m, [np.zeros((1, 2))]
        corners = pitch_m * _directions(np.arange(6) * 60.0 + 30.0)
        for ring in range(1, self.rings + 1):
            steps = np.arange(ring)[:, None] / ring
            sides = [a + steps * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
            around = ring * np.concatenate(sides)
            found.append(around[anticlockwise_from_first(around)])
        return np.concatenate(found)

    @property
    def pieces(self) -> tuple[Part, ...]:
        """See `Part.pieces`: the segments that are there, in the order of their numbers."""
        there = [xy for number, xy in enumerate(self.centres_m.tolist()) if number not in self.missing]
        hexagon = Hexagon(self.flat_to_flat_m)
        return tuple(hexagon.placed(Placement(shift_m=(x, y)).then(self.placement)) for x, y in there)

    @property
    def gapless(self) -> Part:
        return replace(self, flat_to_flat_m=self.flat_to_flat_m + self.gap_m, gap_m=0.0)


@dataclass(frozen=True)
class Samples:
    """A read-only array that is compared and hashed by its content."""

    sha256: str  # of shape and values
    values: np.ndarray = field(compare=False)  # (rows, columns), float64

    @classmethod
    def of(cls, values: np.ndarray) -> Samples:
        """Return a copy of `values`, (rows, columns)."""
        copied = np.array(values, dtype=np.float64)
        copied.flags.writeable = False
        return cls(hashlib.sha256(str(copied.shape).encode() + copied.tobytes()).hexdigest(), copied)


@dataclass(frozen=True)
class AmplitudeMap(Part):
    """Amplitude given by samples.

    Between samples it is interpolated with cubic splines, so that its spectrum is that of the samples as
    far as they resolve it; beyond the map it is dark.

    Row index of the `samples` is y, column index is x; the middle of the array is the origin, and `step_m` is
    the distance between samples.
    """

    title = "map"
    samples: Samples
    step_m: float

    def __post_init__(self) -> None:
        _require(self.step_m > 0, "map: metres per sample", self.step_m, "be positive")
        values, shape = self.samples.values, self.samples.values.shape
        square = values.ndim == 2 and shape[0] == shape[1] and shape[0] >= 8
        _require(square, "map: shape", shape, "be that of a square image of 8 samples or more")
        _require(bool(np.isfinite(values).all()), "map:", "some samples", "be numbers, not NaN or infinite")
        _require(bool((values >= 0).all()), "map: smallest amplitude", values.min(), "not be negative")
        _require(bool((values <= 1 + 1e-6).all()), "map: largest amplitude", values.max(), "not exceed 1")
        _require(bool(values.any()), "map: largest amplitude", 0.0, "be positive: it lets no light pass")

    @property
    def rim_m(self) -> np.ndarray:
        """See `Part.rim_m`: the samples that pass more than half of the largest amplitude."""
        values = self.samples.values
        rows, columns = np.nonzero(values > values.max() / 2)
        return (np.stack([columns, rows]) - (len(values) - 1) / 2) * self.step_m

    @property
    def light_m2(self) -> float:
        """Sum of the squared amplitudes times the area of a sample [m²]."""
        return float(np.sum(self.samples.values**2)) * self.step_m**2

    @property
    def radius_m(self) -> float:
        """See `Part.radius_m`: that of the whole map."""
        return len(self.samples.values) * self.step_m

    def cover(self, x_m: np.ndarray, y_m: np.ndarray, step_m: float) -> np.ndarray:
        """See `Part.cover`: the amplitude, which may ring slightly below 0 and above 1."""
        x_m, y_m = np.broadcast_arrays(*self.placement.back(x_m, y_m))
        middle = (len(self._spline) - 1) / 2
        places = np.stack([y_m, x_m]) / self.step_m + middle
        return scipy.ndimage.map_coordinates(self._spline, places, order=3, prefilter=False)

    @cached_property
    def _spline(self) -> np.ndarray:
        return scipy.ndimage.spline_filter(np.pad(self.samples.values, SPLINE_MARGIN), order=3)

    @cached_property
    def outline(self) -> Part:
        """See `Part.outline`: clear wherever something lit lies around, vanes and holes included."""
        values = self.samples.values
        margin = int(np.ceil(CLOSED_GAPS * len(values)))
        lit = np.pad(values > values.max() / 2, 2 * margin)
        inner = slice(2 * margin, -2 * margin)
        closed = scipy.ndimage.binary_fill_holes(scipy.ndimage.binary_closing(lit, iterations=margin))
        return replace(self, samples=Samples.of(closed[inner, inner]))


PARTS: dict[str, type[Part]] = {part.title: part for part in (Circle, Polygon, Hexagons)}


def anticlockwise_from_first(xy_m: np.ndarray) -> np.ndarray:
    """Return the order, (points,), in which parts at `xy_m` (points, 2) [m] are counted."""
    angles = np.round(np.rad2deg(np.arctan2(xy_m[:, 1], xy_m[:, 0])) - FIRST_DEG, 6)
    nearest = np.argmin(np.abs((angles + 180) % 360 - 180))
    return np.argsort((angles - angles[nearest]) % 360, kind="stable")


def _directions(angles_deg: np.ndarray) -> np.ndarray:
    angles = np.deg2rad(angles_deg)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _require(fits: bool, what: str, value: object, should: str) -> None:
    if not fits:
        shown = f"{value:g}" if isinstance(value, float) else str(value)
        raise ValueError(f"{what} {shown} should {should}")
