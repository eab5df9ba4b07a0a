"""The stages a recipe can name, in the order of the light path.

The module of a stage declares it: settings, results, arrays, checks, what it needs. What needs PyTorch is
imported when the stage runs; so recipes are checked, planned and explained without it. An experiment
of the paper is one module, whose `EXPERIMENT` is the stage.
"""

from __future__ import annotations

from collections import UserDict
from importlib import import_module
from typing import Any

LIGHT_PATH = {
    "ingest": "irlos_pipe.stages.ingest.stage",
    "prior": "irlos_pipe.stages.prior",
    "calibrate": "irlos_pipe.stages.calibrate.stage",
    "lift": "irlos_pipe.stages.lift.stage",
    "sensitivity": "irlos_pipe.stages.sensitivity",
    "correct": "irlos_pipe.stages.correct",
    "derotator": "irlos_pipe.stages.derotator",
    "modes": "irlos_pipe.stages.modes",
    "diagnose": "irlos_pipe.stages.diagnose.stage",
}
# Experiments of the paper on simulated data, each a stage of its own recipe, in the order of the paper.
EXPERIMENTS = (
    "first_tests",
    "exposures",
    "methods",
    "ranking",
    "correction_gain",
    "focus_ramp",
    "ramp_conditions",
    "derotator_series",
    "mirror_loop",
    "faint",
    "mode_statistics",
    "mode_number",
    "low_wind",
    "capture",
    "slow_loop",
    "seeing_scales",
)


class StageRegistry(UserDict[str, Any]):
    """The `Stage` of every name, imported when it is asked for, in the order of the light path."""

    def __getitem__(self, name: str) -> Any:
        module = import_module(self.data[name])
        return getattr(module, "EXPERIMENT", module)


STAGES = StageRegistry(LIGHT_PATH | {name: f"irlos_pipe.paper.{name}" for name in EXPERIMENTS})
