"""Stage `diagnose`: what the model of cubes or a ramp lacks, by name and size, and how the gap shrinks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from irlos_pipe.diagnosis.moments import Moments, placed
from irlos_pipe.diagnosis.options import Options
from irlos_pipe.diagnosis.verdict import Diagnosis
from irlos_pipe.diagnosis.view import Exposures
from irlos_pipe.diagnosis.workflow import diagnose
from irlos_pipe.effects import Effect
from irlos_pipe.estimate.residual import kurtosis_of_frames
from irlos_pipe.product.product import Check
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.calibrate.quality import frame_checks
from irlos_pipe.stages.diagnose.config import Config
from irlos_pipe.stages.diagnose.input import Alike, by_setting, introduced_nm, screened_pixels
from irlos_pipe.stages.diagnose.output import (
    MODEL_FILE,
    diagnose_arrays,
    diagnose_results,
    model_entries,
    model_yaml,
    summary_lines,
)
from irlos_pipe.stages.diagnose.quality import checks_of
from irlos_pipe.stages.diagnose.quality_curves import quality_arrays
from irlos_pipe.stages.diagnose.ramp import run_on_ramp
from irlos_pipe.stages.model.effects import conditions_of, good_pixels, image_effects, model_effects
from irlos_pipe.stages.model.recording_settings import pooled_frames, psf_settings

EXPECTED_FITS = 11  # of one cube, for the progress bar
APART = {"auto": None, "together": False, "apart": True}


def run(ctx: StageContext[Config]) -> StageOutput:
    """Diagnose the recipe's input: behind the stage `lift` a ramp, else cubes of one wavefront."""
    if "lift" in ctx.products:
        output, entries = run_on_ramp(ctx, round(1 / ctx.config.held_out))
        return replace(output, files={MODEL_FILE: model_yaml(ctx.model, entries)})
    apart = APART[ctx.config.recordings]
    groups = by_setting(ctx.products["ingest"], ctx.config.input, apart=apart)
    result, settings = _diagnose(ctx, groups), psf_settings(ctx.instrument, ctx.model, groups[0].first)
    model = model_yaml(ctx.model, model_entries(result))
    results = diagnose_results(result, groups[0].first.acquisition.diversity)
    return StageOutput(
        diagnose_arrays(result) | quality_arrays(result.pictures, settings),
        results,
        [*checks_of(results), *(check for alike in groups for check in _frame_checks(ctx, alike))],
        files={MODEL_FILE: model},
        summary=summary_lines(result),
    )


def _frame_checks(ctx: StageContext[Config], alike: Alike) -> list[Check]:
    window = alike.first.window
    settings = psf_settings(ctx.instrument, ctx.model, alike.first)
    frames = pooled_frames(alike.recordings, np.ones(window, bool), settings)
    return frame_checks(kurtosis_of_frames(frames), frames.motion, window)


def _diagnose(ctx: StageContext[Config], groups: list[Alike]) -> Diagnosis:
    config = ctx.config
    effects: dict[int, list[Effect]] = {}
    for alike in groups:
        if alike.moment not in effects:
            effects[alike.moment] = model_effects(ctx.instrument, ctx.model, alike.first, config.highest_noll)
    exposures = [_exposures(ctx, alike, effects[alike.moment]) for alike in groups]
    options = Options(
        config.highest_noll,
        config.held_out,
        config.most_names,
        config.sure_sigma,
        config.night_drift_nm,
        config.begin_near,
    )
    in_images = {moment: image_effects(some) for moment, some in effects.items()}
    model = placed(in_images, Moments.of(exposures))
    with ctx.progress(total=EXPECTED_FITS * len(effects), desc="diagnose") as bar:
        return diagnose(exposures, model, options, device=ctx.device, report=bar.update)


def _exposures(ctx: StageContext[Config], alike: Alike, effects: list[Effect]) -> Exposures:
    """Recordings of one setting and moment, the introduced defocus in the known wavefront."""
    first = alike.first
    conditions = conditions_of(
        ctx.instrument, ctx.model, first, ctx.config.highest_noll, introduced_nm={4: introduced_nm(first)}
    )
    return Exposures(
        pooled_frames(alike.recordings, good_pixels(effects, first.window), conditions.settings),
        conditions,
        screened_pixels(ctx.products["ingest"], first),
        alike.moment,
        first.name,
        alike.star,
    )
