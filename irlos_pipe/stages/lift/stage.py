"""Stage `lift`: tip, tilt and defocus of every frame of a ramp, the NCPAs in the known wavefront."""

from __future__ import annotations

from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.lift.config import Config
from irlos_pipe.stages.lift.results import ARRAYS, CHECKS
from irlos_pipe.stages.lift.results import LiftResults as Results

__all__ = ["ARRAYS", "CHECKS", "Config", "Results", "run"]

NAME = "lift"
VERSION = 16
NEEDS = ("ingest",)
READS = ("ingest", "prior", "calibrate")


def run(ctx: StageContext[Config]) -> StageOutput:
    """Estimate the ramp, and repeat it with parts of the model left out to show what each contributes."""
    from irlos_pipe.stages.lift.work import run as work

    return work(ctx)
