"""Stage `diagnose`: what the model of cubes or a ramp lacks, by name and size, and how the gap shrinks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from pydantic import Field

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.diagnose.acceptance import Options
from irlos_pipe.diagnose.verdict import Diagnosis
from irlos_pipe.diagnose.view import Exposures
from irlos_pipe.diagnose.workflow import diagnose
from irlos_pipe.effects import Effect
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.frames.recording import Recording
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.diagnose.input import by_setting, introduced_nm, screened_pixels
from irlos_pipe.stages.diagnose.output import (
    MODEL_FILE,
    diagnose_arrays,
    diagnose_results,
    model_entries,
    model_yaml,
    summary_lines,
)
from irlos_pipe.stages.diagnose.quality import checks_of
from irlos_pipe.stages.diagnose.ramp import run_on_ramp
from irlos_pipe.stages.model.effects import conditions_of, good_pixels, image_effects, model_effects
from irlos_pipe.stages.model.recording_settings import pooled_images

NAME = "diagnose"
VERSION = 10
NEEDS = ("ingest",)
READS = ("ingest", "calibrate", "lift")
EXPECTED_FITS = 11  # of one cube, for the progress bar


class Config(StageConfig):
    """Settings of the diagnosis."""

    input: str = Field("cube", description="recipe input that holds the cubes, or the ramp")
    highest_noll: int = Field(
        66, ge=4, le=231, description="modes 2 to this belong to every model; beyond: high_order_ncpa"
    )
    held_out: float = Field(
        0.25,
        gt=0.05,
        le=0.5,
        description="part of the frames, or of the pixels of fewer than 16, that no fit sees",
    )
    most_names: int = Field(4, ge=1, le=10, description="names at which to stop")
    sure_sigma: float = Field(5.0, ge=3, le=20, description="significance of a detection")


def run(ctx: StageContext[Config]) -> StageOutput:
    """Diagnose the recipe's input: behind the stage `lift` a ramp, else cubes of one wavefront."""
    if "lift" in ctx.products:
        output, entries = run_on_ramp(ctx, round(1 / ctx.config.held_out))
        return replace(output, files={MODEL_FILE: model_yaml(ctx.model, entries)})
    result = _diagnose(ctx, by_setting(ctx.products["ingest"], ctx.config.input))
    model = model_yaml(ctx.model, model_entries(result))
    results = diagnose_results(result)
    return StageOutput(
        diagnose_arrays(result),
        results,
        checks_of(results),
        files={MODEL_FILE: model},
        summary=summary_lines(result),
    )


def _diagnose(ctx: StageContext[Config], settings: list[list[Recording]]) -> Diagnosis:
    config = ctx.config
    effects = model_effects(ctx.instrument, ctx.model, settings[0][0], config.highest_noll)
    exposures = [_exposures(ctx, alike, effects) for alike in settings]
    options = Options(config.highest_noll, config.held_out, config.most_names, config.sure_sigma)
    with ctx.progress(total=EXPECTED_FITS, desc="diagnose") as bar:
        return diagnose(exposures, image_effects(effects), options, device=ctx.device, report=bar.update)


def _exposures(ctx: StageContext[Config], alike: list[Recording], effects: list[Effect]) -> Exposures:
    """Recordings of one setting, the introduced defocus in the known wavefront."""
    first = alike[0]
    return Exposures(
        pooled_frames(alike, good_pixels(effects, first.window)),
        conditions_of(
            ctx.instrument,
            ctx.model,
            first,
            ctx.config.highest_noll,
            introduced_nm={4: introduced_nm(first)},
        ),
        screened_pixels(ctx.products["ingest"], first),
    )


def pooled_frames(recordings: Sequence[Recording], good: np.ndarray) -> Frames:
    """Return the frames of `recordings` of one setting; pixels that are not `good` are masked.

    Raises
    ------
    InputDataError
        Without a frame.
    """
    images_e, recorded_good, noise = pooled_images(recordings)
    if not len(images_e):
        raise InputDataError(f"{recordings[0].name}: no used frame is left to diagnose")
    return Frames(images_e, recorded_good & torch.as_tensor(good), noise)
