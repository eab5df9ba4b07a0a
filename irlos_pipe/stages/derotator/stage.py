"""Stage `derotator`: the part of the NCPAs that turns with the derotator, and the part that does not."""

from __future__ import annotations

from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.derotator.config import Config
from irlos_pipe.stages.derotator.results import DerotatorResults as Results

__all__ = ["Config", "Results", "run"]

NAME = "derotator"
VERSION = 1
NEEDS = ("calibrate",)
READS = ("calibrate",)
DEPENDS_ON = frozenset({"instrument"})


def run(ctx: StageContext[Config]) -> StageOutput:
    """Split the estimates of all cubes; report that this cannot be done with a single angle."""
    from irlos_pipe.stages.derotator.work import run as work

    return work(ctx)
