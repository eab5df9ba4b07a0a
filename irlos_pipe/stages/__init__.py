"""The stages a recipe can name, in the order of the light path.

Modules are imported when first asked for, so that a recipe loads only what it uses.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from irlos_pipe.stages.base import Stage

LIGHT_PATH = (
    "ingest",
    "prior",
    "calibrate",
    "lift",
    "sensitivity",
    "correct",
    "derotator",
    "modes",
    "diagnose",
)
# Experiments of the paper on simulated data, each a stage of its own recipe, in the order of the paper.
EXPERIMENTS = (
    "first_tests",
    "methods",
    "correction_gain",
    "focus_ramp",
    "derotator_series",
    "faint",
    "mode_statistics",
    "mode_number",
    "capture",
    "slow_loop",
    "seeing_scales",
)


class StageRegistry(Mapping[str, "Stage"]):
    """Stage modules by name, iterated in the order of the light path."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._names = names

    def __getitem__(self, name: str) -> Stage:
        if name not in self._names:
            raise KeyError(name)
        return import_module(f"irlos_pipe.stages.{name}")

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


STAGES: Mapping[str, Stage] = StageRegistry((*LIGHT_PATH, *EXPERIMENTS))
