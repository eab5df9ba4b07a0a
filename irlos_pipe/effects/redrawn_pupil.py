"""Effects that change the drawing of the pupil: where its edges are.

Edges are drawn on a grid of a few mm and band-limited. Several such effects make one drawing: the edge of a
turned vane that is wider than declared is where both say. What gives parts of the pupil a wavefront of their
own (`divided_pupil`) has the parts of that drawing: petals turn with the vanes.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.conventions.pupil_drawing import ON_AXIS, PupilGeometry, turned, with_sizes
from irlos_pipe.effects.base import Effect, FixedEffect, Several
from irlos_pipe.effects.declaration import Conditions, Parameter, Public
from irlos_pipe.effects.planes import PupilEffect
from irlos_pipe.numerics.directional import with_pullback
from irlos_pipe.optics.grids import PupilGrid
from irlos_pipe.optics.pupil import Division, Edges, band_limited, pupil_edges

CELL_M = 0.008  # side of the fine cells of the drawing
DIRECTIONS = 8  # in which a search shifts the stop
# Prior, bounds and plausible range of the sizes of hole and vanes, in units of the declared ones.
SIGMA = 0.1
LEAST, MOST = 0.3, 2.5
PLAUSIBLE = (0.5, 1.6)


class Drawing(NamedTuple):
    """A pupil, and where an internal stop of its outline and hole lies [m]."""

    geometry: PupilGeometry
    stop_m: tuple[float, float] = ON_AXIS
    turned_deg: float = 0.0  # against the declared pupil


class DrawnEffect(PupilEffect):
    """Acts on where there is light: on the drawing of the pupil, or on parts of what is drawn."""

    order = 0  # changes where there is light, before what multiplies it
    joins = "redrawn_pupil"


class RedrawnPupil(DrawnEffect):
    """Changes the drawing of the pupil."""

    @classmethod
    def together(cls, effects: Sequence[Effect]) -> Effect:
        return RedrawnTogether(effects)

    def redrawn(self, values: Sequence[float], drawing: Drawing) -> Drawing:
        """The `drawing` with the effect at `values`."""
        raise NotImplementedError

    def edge_slope(self, values: Sequence[float], index: int, edges: Edges) -> np.ndarray:
        """Derivative of the amplitude at `values` with respect to the parameter `index`, (n, n).

        The `edges` are those of the whole drawing, other effects included.
        """
        raise NotImplementedError

    def apply(self, values: Tensor, field: Tensor, grid: PupilGrid) -> Tensor:
        every = range(len(values))
        change = differentiable(
            values, lambda v: self._changed(v, grid), lambda v: slopes_of_drawing(self, grid, v, every)
        )
        return field + change * grid.light

    def _changed(self, values: Tensor, grid: PupilGrid) -> Tensor:
        declared = Drawing(grid.geometry)
        drawing = self.redrawn(values.tolist(), declared)
        return torch.tensor(_drawn(drawing, grid.samples) - _drawn(declared, grid.samples))

    def slopes(self, values: Tensor, field: Tensor, grid: PupilGrid, wanted: Sequence[int]) -> list[Tensor]:
        every = torch.ones_like(grid.wavelengths_m, dtype=torch.complex128) * grid.light
        return [every * slope for slope in slopes_of_drawing(self, grid, values, wanted)]


class RedrawnTogether(Several, RedrawnPupil):
    """Several effects that make one drawing: each a `RedrawnPupil`, some of whose parameters may be held."""

    name = "redrawn_pupil"

    def __init__(self, effects: Sequence[Effect]):
        super().__init__(effects)
        self._owners = [(number, index) for number, one in enumerate(effects) for index in one.free]

    def redrawn(self, values: Sequence[float], drawing: Drawing) -> Drawing:
        for effect, own in self._each(values):
            drawing = effect.redrawn(own, drawing)
        return drawing

    def edge_slope(self, values: Sequence[float], index: int, edges: Edges) -> np.ndarray:
        number, own_index = self._owners[index]
        effect, own = self._each(values)[number]
        return effect.edge_slope(own, own_index, edges)

    def _each(self, values: Sequence[float]) -> list[tuple[RedrawnPupil, list[float]]]:
        """Every effect with all its parameters."""
        pairs = zip(self.every, self.all_of_each(torch.tensor(values, dtype=torch.float64)), strict=True)
        return [(one.base, own.tolist()) for one, own in pairs]  # type: ignore[misc]


def differentiable(
    values: Tensor,
    drawn: Callable[[Tensor], Tensor],
    slopes: Callable[[Tensor], Sequence[Tensor]],
) -> Tensor:
    """What is `drawn` at `values`, (parameters,), whose derivatives are `slopes`, one per parameter."""

    def pullback(values: Tensor, upstream: Tensor) -> Tensor:
        return torch.stack([(upstream * slope).sum() for slope in slopes(values.detach())])

    return with_pullback(values, drawn, pullback) if len(values) else drawn(values)


def slopes_of_drawing(
    effect: RedrawnPupil,
    grid: PupilGrid,
    values: Tensor,
    wanted: Sequence[int],
    division: Division | None = None,
) -> list[Tensor]:
    """Derivatives of the amplitude of the pupil, (n, n) each, or of its parts, (parts, n, n) each.

    They are those of the drawing that an `effect` makes at `values` on `grid`, by the `wanted` parameters;
    with a `division`, of the parts.
    """
    numbers = values.tolist()
    geometry, stop_m, _ = effect.redrawn(numbers, Drawing(grid.geometry))
    edges = pupil_edges(geometry, grid.samples, subsamples_of(geometry, grid.samples), stop_m, division)
    return [torch.as_tensor(effect.edge_slope(numbers, index, edges)) for index in wanted]


@lru_cache(maxsize=16)
def _drawn(drawing: Drawing, samples: int) -> np.ndarray:
    """Band-limited amplitude, (n, n)."""
    geometry, stop_m, _ = drawing
    return band_limited(geometry, samples, stop_m=stop_m, subsamples=subsamples_of(geometry, samples))


def subsamples_of(geometry: PupilGeometry, samples: int) -> int:
    """Even number of fine cells of about `CELL_M` per coarse cell, `samples` across a `geometry`."""
    return 2 * int(np.ceil(geometry.diameter_m / samples / CELL_M / 2))


class PupilMisregistration(RedrawnPupil):
    """An internal stop that does not lie on the image of the telescope pupil, and vanes that are turned.

    The stop has the outline and the central hole of the pupil, but no vanes or gaps between segments; light
    passes where both do. Of a disc, the vanes and other obstructions are turned; of a segmented pupil or a
    map, all of it.

    Any shift darkens a crescent at the rim and one at the hole, whichever way it goes: the image is not
    differentiable in (dx, dy) at zero, but it is in (distance ≥ 0, direction).

    Parameters: `start`, distance [m], direction and rotation [deg].
    """

    name = "pupil_misregistration"
    formula = (
        "P(u) → P(u; vanes turned by rotation_deg) · S(u − (dx_m, dy_m)); S: stop with outline and hole of P"
    )
    fact = varies = True
    public = (
        Public("dx_m", "m", -1.0, 1.0, role="component"),
        Public("dy_m", "m", -1.0, 1.0, role="component"),
        Public("rotation_deg", "deg of the vanes, anticlockwise", -180.0, 180.0),
    )
    look_alike = "amplitude_aberration of Noll 2 and 3, which has no sharp edges"
    reference = "Dohlen et al. 2006, SPIE 6269, 62690Q; VLT pupil stops"

    def __init__(self, start: tuple[float, float, float] = (0.03, 0.0, 0.0)):
        distance, direction, rotation = start
        self.parameters = (
            Parameter("distance_m", "m", distance, 0.0, 0.3, 0.0, 1.0, plausible=(0.0, 0.5)),
            Parameter("direction_rad", "rad", np.deg2rad(direction), null=None),
            Parameter("rotation_deg", "deg", rotation, 0.0, 5.0, -45.0, 45.0, plausible=(-15.0, 15.0)),
        )

    def redrawn(self, values: Sequence[float], drawing: Drawing) -> Drawing:
        distance_m, direction_rad, rotation_deg = values
        stop_m = (float(distance_m * np.cos(direction_rad)), float(distance_m * np.sin(direction_rad)))
        turned_deg = drawing.turned_deg + rotation_deg
        return Drawing(turned(drawing.geometry, rotation_deg), stop_m, turned_deg)

    def edge_slope(self, values: Sequence[float], index: int, edges: Edges) -> np.ndarray:
        distance_m, direction_rad, _ = values
        if index == 2:
            return edges.turned() * np.pi / 180
        towards = np.array([np.cos(direction_rad), np.sin(direction_rad)])
        velocity = towards if index == 0 else distance_m * np.array([-towards[1], towards[0]])
        return edges.moved((float(velocity[0]), float(velocity[1])))

    def describe(self, values: np.ndarray) -> dict[str, float]:
        distance, direction, rotation = (float(v) for v in values)
        return {
            "dx_m": distance * float(np.cos(direction)),
            "dy_m": distance * float(np.sin(direction)),
            "rotation_deg": rotation,
        }

    def phrase(self, public: Mapping[str, Any]) -> str:
        """See `Effect.phrase`: what rounds to nothing is left out."""
        x, y, turn = (public[key] for key in ("dx_m", "dy_m", "rotation_deg"))
        turned = f"vanes turned by {turn:+.1f}° against the profile" if round(turn, 1) else ""
        moved = f"a stop {x:+.3f}, {y:+.3f} m off" if round(x, 3) or round(y, 3) else ""
        return " and ".join(filter(None, [turned, moved])) or "an internal stop in its place"

    def values_of(self, dx_m: float, dy_m: float, rotation_deg: float) -> list[float]:
        return [float(np.hypot(dx_m, dy_m)), float(np.arctan2(dy_m, dx_m)), rotation_deg]

    def candidates(self, window: tuple[int, int], pixel_scale_mas: float) -> list[Effect]:
        angles = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
        shifts = [FixedEffect(self, [0.0, angle, 0.0], free=("distance_m",)) for angle in angles]
        return [*shifts, FixedEffect(self, [0.0, 0.0, 0.0], free=("rotation_deg",))]


class PupilSizes(RedrawnPupil):
    """The hole of the pupil and the vanes are larger or smaller than declared.

    Drawings of instruments disagree, stops are oversized, and what a camera's stop covers is not what the
    telescope's mirror does. The sizes are absolute. Vanes of several widths are all wider in the same
    ratio. The diameter is no parameter: in the image it is the same as the pixel scale, or the wavelength.

    Raises `ValueError` if it has neither a hole nor vanes.
    """

    name = "pupil_geometry"
    formula = "P(u) drawn with the hole obscuration_m wide and vanes of mean width vane_width_m"
    fact = varies = True
    public = (
        Public("obscuration_m", "m, diameter, not its change", 0.0, 50.0, required=False),
        Public("vane_width_m", "m, mean of all vanes, not its change", 0.0, 5.0, required=False),
    )
    look_alike = (
        "pupil_misregistration, whose stop darkens one side; amplitude_aberration, which has no edges"
    )
    reference = "Hayward et al. 2001, PASP 113, 105, on stops and vanes of PHARO"

    def __init__(self, told: PupilGeometry):
        sizes_m = {"obscuration_m": told.obscuration_m, "vane_width_m": told.vane_width_m}
        self.told_m = {name: size_m for name, size_m in sizes_m.items() if size_m > 0}
        if not self.told_m:
            raise ValueError("the pupil has neither a central obscuration nor vanes")
        self.parameters = tuple(_size(name, size_m) for name, size_m in self.told_m.items())

    @classmethod
    def under(cls, conditions: Conditions) -> "PupilSizes":
        return cls(conditions.settings.geometry)

    def redrawn(self, values: Sequence[float], drawing: Drawing) -> Drawing:
        sizes_m = {p.name: value for p, value in zip(self.parameters, values, strict=True)}
        return drawing._replace(geometry=with_sizes(drawing.geometry, **sizes_m))

    def edge_slope(self, values: Sequence[float], index: int, edges: Edges) -> np.ndarray:
        return edges.obscured() if self.parameters[index].name == "obscuration_m" else edges.widened()

    def values_of(self, obscuration_m: float | None = None, vane_width_m: float | None = None) -> list[float]:
        """See `Effect.values_of`: what is not given is as declared.

        Raises `ValueError` for the size of what the pupil has not.
        """
        sizes = {"obscuration_m": obscuration_m, "vane_width_m": vane_width_m}
        given = {name: size_m for name, size_m in sizes.items() if size_m is not None}
        missing = sorted({*given} - {*self.told_m})
        if missing:
            raise ValueError(f"the pupil has nothing of which {', '.join(missing)} would be the size")
        return [given.get(name, size_m) for name, size_m in self.told_m.items()]

    def phrase(self, public: Mapping[str, Any]) -> str:
        """See `Effect.phrase`: corrected and declared sizes; what rounds to the declared one is left out."""
        pieces = {"obscuration_m": "a central obscuration of {} m instead of {} m"}
        pieces["vane_width_m"] = "vanes {} m wide instead of {} m"
        changed = [
            pieces[name].format(_text(name, public[name]), _text(name, declared))
            for name, declared in self.told_m.items()
            if _text(name, float(public[name])) != _text(name, declared)
        ]
        return " and ".join(changed) or "a pupil as declared"


def _size(name: str, declared_m: float) -> Parameter:
    low, high = (share * declared_m for share in (LEAST, MOST))
    plausible = (PLAUSIBLE[0] * declared_m, PLAUSIBLE[1] * declared_m)
    return Parameter(name, "m", declared_m, declared_m, SIGMA * declared_m, low, high, declared_m, plausible)


def _text(name: str, size_m: float) -> str:
    """Size as a sentence has it, in metres."""
    return f"{size_m:.2f}" if name == "obscuration_m" else f"{size_m:.3f}"
