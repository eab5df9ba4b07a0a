"""Stage `calibrate`: static aberrations (NCPAs) from cubes of short narrow-band exposures."""

from __future__ import annotations

from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.calibrate.config import Config
from irlos_pipe.stages.calibrate.results import ARRAYS, CHECKS
from irlos_pipe.stages.calibrate.results import CalibrateResults as Results

__all__ = ["ARRAYS", "CHECKS", "Config", "Results", "run"]

NAME = "calibrate"
VERSION = 24
NEEDS = ("ingest",)
READS = ("ingest",)


def run(ctx: StageContext[Config]) -> StageOutput:
    """Calibrate with the chosen method, and with the methods to compare."""
    from irlos_pipe.stages.calibrate.work import run as work

    return work(ctx)
