"""What every simulated effect has. Each plane of the light path is a file, headed by what may change there.

An effect is a frozen dataclass whose fields are its parameters. Names, units and limits of the parameters
that models and reports know stand in `irlos_pipe.effects`. A field says by `key` what differs from that:
limits of what can be simulated, if more than models accept; meaning and limits of what only the simulator
has. A new effect is one class in the file of its plane; the order of classes there is the order in which they
act.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from irlos_pipe.conventions.pupil_drawing import PupilGeometry


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
