"""`pupil_geometry`: a central obscuration and vanes of other sizes than the profile tells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, with_sizes
from irlos_pipe.effects.declaration import Conditions, Parameter, number
from irlos_pipe.effects.redrawn_pupil import Drawing, RedrawnPupil
from irlos_pipe.optics.pupil_edges import Edges

SIGMA = 0.1  # of the told size
LEAST, MOST = 0.3, 2.5  # the same
PLAUSIBLE = (0.5, 1.6)


class PupilSizes(RedrawnPupil):
    """The hole of the pupil and the vanes are larger or smaller than told.

    Drawings of instruments disagree, stops are oversized, and what a camera's stop covers is not what the
    telescope's mirror does. The sizes are absolute. Vanes of several widths are all wider in the same
    ratio. The diameter is no parameter: in the image it is the same as the pixel scale, or the wavelength.

    Parameters
    ----------
    told : PupilGeometry

    Raises
    ------
    ValueError
        If it has neither a hole nor vanes.
    """

    name = "pupil_geometry"
    formula = "P(u) drawn with the hole obscuration_m wide and vanes of mean width vane_width_m"
    fact = varies = True
    public = (
        number("obscuration_m", "m, diameter, not its change", 0.0, 50.0, required=False),
        number("vane_width_m", "m, mean of all vanes, not its change", 0.0, 5.0, required=False),
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
    def under(cls, conditions: Conditions) -> PupilSizes:
        """See `Effect.under`."""
        return cls(conditions.settings.geometry)

    def redrawn(self, values: Sequence[float], drawing: Drawing) -> Drawing:
        """See `RedrawnPupil.redrawn`."""
        return drawing._replace(geometry=with_sizes(drawing.geometry, **self._named(values)))

    def edge_slope(self, values: Sequence[float], index: int, edges: Edges) -> np.ndarray:
        """See `RedrawnPupil.edge_slope`."""
        return edges.obscured() if self.parameters[index].name == "obscuration_m" else edges.widened()

    def values_of(self, obscuration_m: float | None = None, vane_width_m: float | None = None) -> list[float]:
        """See `Effect.values_of`: what is not given is as told.

        Raises
        ------
        ValueError
            For the size of what the pupil has not.
        """
        wanted = {"obscuration_m": obscuration_m, "vane_width_m": vane_width_m}
        given = {name: size_m for name, size_m in wanted.items() if size_m is not None}
        missing = sorted({*given} - {*self.told_m})
        if missing:
            raise ValueError(f"the pupil has nothing of which {', '.join(missing)} would be the size")
        return [given.get(name, size_m) for name, size_m in self.told_m.items()]

    def phrase(self, public: Mapping[str, Any]) -> str:
        """See `Effect.phrase`: the wanted and the told sizes; what rounds to the told one is left out."""
        pieces = {"obscuration_m": "a central obscuration of {} m instead of {} m"}
        pieces["vane_width_m"] = "vanes {} m wide instead of {} m"
        changed = [
            pieces[name].format(_text(name, public[name]), _text(name, told))
            for name, told in self.told_m.items()
            if _text(name, float(public[name])) != _text(name, told)
        ]
        return " and ".join(changed) or "a pupil as told"

    def _named(self, values: Sequence[float]) -> dict[str, float]:
        return {p.name: value for p, value in zip(self.parameters, values, strict=True)}


def _size(name: str, told_m: float) -> Parameter:
    low, high = (share * told_m for share in (LEAST, MOST))
    plausible = (PLAUSIBLE[0] * told_m, PLAUSIBLE[1] * told_m)
    return Parameter(name, "m", told_m, told_m, SIGMA * told_m, low, high, told_m, plausible)


def _text(name: str, size_m: float) -> str:
    """Size as a sentence has it, in metres."""
    return f"{size_m:.2f}" if name == "obscuration_m" else f"{size_m:.3f}"
