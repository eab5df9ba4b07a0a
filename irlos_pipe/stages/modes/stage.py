"""Stage `modes`: how strong the modes are (paper, appendix A), and how many to estimate (appendix B)."""

from __future__ import annotations

from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.modes.config import Config
from irlos_pipe.stages.modes.results import ModesResults as Results

__all__ = ["Config", "Results", "run"]

NAME = "modes"
VERSION = 4
NEEDS = ("ingest", "calibrate")
READS = ("ingest", "calibrate")


def run(ctx: StageContext[Config]) -> StageOutput:
    """Fit a law to the scatter of the modes, and try several numbers of modes."""
    from irlos_pipe.stages.modes.work import run as work

    return work(ctx)
