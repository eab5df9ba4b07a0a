"""What a stage is given when a test runs it by itself."""

import logging
from pathlib import Path

from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.pipeline.resources import silent_progress
from irlos_pipe.stages.base import ModelConfig, StageConfig, StageContext


def stage_context(config: StageConfig, **changes) -> StageContext:
    """Return the context of a stage without inputs and products, but for what is changed."""
    usual = {
        "model": ModelConfig(), "instrument": load_instrument("irlos"), "inputs": {}, "products": {},
        "device": "cpu", "seed": 0, "jobs": 1, "progress": silent_progress,
        "log": logging.getLogger("test"), "scratch": Path("scratch"),
    }  # fmt: skip
    return StageContext(config=config, **usual | changes)
