"""What every simulated effect has. Each plane of the light path is a file, headed by what may change there.

An effect is a frozen dataclass whose fields are its parameters. Names, units and limits of the parameters
that models and reports know stand in `irlos_pipe.effects`; the simulator's own ones are declared by `own`.
A new effect is one class in the file of its plane; the order of classes there is the order in which they act.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field
from typing import Any, ClassVar

from irlos_pipe.conventions.pupil_drawing import PupilGeometry

INFINITE = float("inf")


@dataclass(frozen=True)
class Own:
    """A parameter that only the simulator has: its unit, and the limits of every number in it."""

    unit: str
    lower: float = -INFINITE
    upper: float = INFINITE


def own(unit: str, lower: float = -INFINITE, upper: float = INFINITE, default: Any = None) -> Any:
    """Declare a field that only the simulator has: `unit`, limits `lower` and `upper`, and its `default`."""
    return field(default=default, metadata={"own": Own(unit, lower, upper)})


def wider(lower: float, upper: float, default: Any = MISSING) -> Any:
    """Declare a field of which more can be simulated than models accept, from `lower` to `upper`.

    Without a `default` it is required.
    """
    return field(default=default, metadata={"wider": (lower, upper)})


@dataclass(frozen=True)
class RecordingSetup:
    """Pupil, number of bands, window (rows, columns), diversity [nm RMS by Noll], which effects must fit."""

    geometry: PupilGeometry
    bands: int
    window: tuple[int, int]
    diversity_nm: Mapping[int, float]


@dataclass(frozen=True)
class SimulatedEffect:
    """An effect by its name in recipes, models, truth files and reports."""

    name: ClassVar[str]

    def misfit(self, setup: RecordingSetup) -> str:
        """Return why the effect cannot be in a recording of this `setup`; empty if it can."""
        return ""
