"""Stage `prior`: defocus of every frame of a ramp from the elongation of its image."""

from __future__ import annotations

from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.prior.config import Config
from irlos_pipe.stages.prior.results import PriorResults as Results

__all__ = ["Config", "Results", "run"]

NAME = "prior"
VERSION = 2
NEEDS = ("ingest",)
READS = ("ingest",)


def run(ctx: StageContext[Config]) -> StageOutput:
    """Calibrate A and B from the model and apply them to every used frame."""
    from irlos_pipe.stages.prior.work import run as work

    return work(ctx)
