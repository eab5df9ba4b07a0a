"""Stage `correct`: the modal offsets for SPARTA, and what they would do to the image."""

from __future__ import annotations

from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.correct.config import Config
from irlos_pipe.stages.correct.results import CorrectResults as Results

__all__ = ["Config", "Results", "run"]

NAME = "correct"
VERSION = 6
NEEDS = ("ingest", "calibrate")
READS = ("ingest", "calibrate")


def run(ctx: StageContext[Config]) -> StageOutput:
    """Write the offsets as CSV and FITS, and predict the image before and after the correction."""
    from irlos_pipe.stages.correct.work import run as work

    return work(ctx)
