"""Stage `sensitivity`: defocus error against magnitude, with and without NCPAs, few and many modes."""

from __future__ import annotations

from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.sensitivity.config import Config
from irlos_pipe.stages.sensitivity.results import SensitivityResults as Results

__all__ = ["Config", "Results", "run"]

NAME = "sensitivity"
VERSION = 9
NEEDS = ("ingest",)
READS = ("ingest", "prior", "calibrate")


def run(ctx: StageContext[Config]) -> StageOutput:
    """Scan every combination of modes and calibration."""
    from irlos_pipe.stages.sensitivity.work import run as work

    return work(ctx)
