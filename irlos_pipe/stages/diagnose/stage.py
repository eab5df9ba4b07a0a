"""Stage `diagnose`: what the model of cubes or a ramp lacks, by name and size, and how the gap shrinks."""

from __future__ import annotations

from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.diagnose.config import Config
from irlos_pipe.stages.diagnose.results import ARRAYS, CHECKS
from irlos_pipe.stages.diagnose.results import DiagnoseResults as Results

__all__ = ["ARRAYS", "CHECKS", "Config", "Results", "run"]

NAME = "diagnose"
VERSION = 28
NEEDS = ("ingest",)
READS = ("ingest", "calibrate", "lift")


def run(ctx: StageContext[Config]) -> StageOutput:
    """Diagnose the recipe's input: behind the stage `lift` a ramp, else cubes of one wavefront."""
    from irlos_pipe.stages.diagnose.work import run as work

    return work(ctx)
