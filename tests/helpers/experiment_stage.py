"""Run the stage of an experiment on samples that are there already, and build its section of the report."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.pipeline.resources import silent_progress
from irlos_pipe.product.product import Product
from irlos_pipe.report.content import Section
from irlos_pipe.report.run_data import RunData
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.model.section import ModelConfig


def context(config, seed: int = 5) -> StageContext:
    return StageContext(
        config,
        ModelConfig(),
        load_instrument("irlos"),
        {},
        {},
        "cpu",
        seed,
        1,
        silent_progress,
        logging.getLogger("test"),
        Path("scratch"),
    )


def run_stage(monkeypatch, stage, config, found_of: Callable) -> StageOutput:
    """Return the output of a stage whose samples give ``found_of(sample)``."""
    monkeypatch.setattr(
        stage, "run_samples", lambda function, samples, ctx, desc: [found_of(sample) for sample in samples]
    )
    return stage.run(context(config))


def section_of(output: StageOutput, name: str, build: Callable[[RunData], Section], config=None) -> Section:
    """Build the section of a stage's output as it is read back from its product."""
    settings = config.model_dump() if config else {}
    product = Product(name, output.arrays, output.results.as_json(), config=settings)
    return build(RunData({}, "", "ok", "", "", {name: product}, []))
