"""Stage `diagnose`: what the model of cubes or a ramp lacks, by name and size, and how the gap shrinks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.diagnosis.options import Options
from irlos_pipe.diagnosis.verdict import Diagnosis
from irlos_pipe.diagnosis.view import Exposures, Moments, Screened, placed
from irlos_pipe.diagnosis.workflow import diagnose
from irlos_pipe.effects import Effect
from irlos_pipe.estimate.cube import kurtosis_of_frames
from irlos_pipe.frames.recording import Recording
from irlos_pipe.product.product import Product
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.calibrate.quality import frame_checks
from irlos_pipe.stages.diagnose.output import (
    MODEL_FILE,
    checks_of,
    diagnose_arrays,
    diagnose_results,
    model_entries,
    model_yaml,
    quality_arrays,
    summary_lines,
)
from irlos_pipe.stages.diagnose.ramp import run_on_ramp
from irlos_pipe.stages.diagnose.stage import Config
from irlos_pipe.stages.ingest.stage import recordings_from_product, screened_e
from irlos_pipe.stages.model.effects import (
    conditions_of,
    good_pixels,
    image_effects,
    in_time_order,
    model_effects,
    pooled_frames,
    psf_settings,
)
from irlos_pipe.stages.model.groups import require_common

EXPECTED_FITS = 11  # fits that one cube takes, for the progress bar
APART = {"auto": None, "together": False, "apart": True}


def run(ctx: StageContext[Config]) -> StageOutput:
    """Diagnose the recipe's input: behind the stage `lift` a ramp, else cubes of one wavefront."""
    if "lift" in ctx.products:
        output, entries = run_on_ramp(ctx, round(1 / ctx.config.held_out))
        return replace(output, files={MODEL_FILE: model_yaml(ctx.model, entries)})
    apart = APART[ctx.config.recordings]
    groups = _by_setting(ctx.products["ingest"], ctx.config.input, apart=apart)
    result, settings = _diagnose(ctx, groups), psf_settings(ctx.instrument, ctx.model, groups[0].first)
    model = model_yaml(ctx.model, model_entries(result))
    results = diagnose_results(result, groups[0].first.acquisition.diversity)
    checks = checks_of(results)
    for alike in groups:
        window = alike.first.window
        of_frames = psf_settings(ctx.instrument, ctx.model, alike.first)
        frames = pooled_frames(alike.recordings, np.ones(window, bool), of_frames)
        checks += frame_checks(kurtosis_of_frames(frames), frames.motion, window)
    return StageOutput(
        diagnose_arrays(result) | quality_arrays(result.pictures, settings),
        results,
        checks,
        files={MODEL_FILE: model},
        summary=summary_lines(result),
    )


def _diagnose(ctx: StageContext[Config], groups: "list[Alike]") -> Diagnosis:
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


def _exposures(ctx: StageContext[Config], alike: "Alike", effects: list[Effect]) -> Exposures:
    """Recordings of one setting and moment, the introduced defocus in the known wavefront."""
    first = alike.first
    conditions = conditions_of(
        ctx.instrument, ctx.model, first, ctx.config.highest_noll, introduced_nm={4: _introduced_nm(first)}
    )
    shown_e = screened_e(ctx.products["ingest"], first)
    return Exposures(
        pooled_frames(alike.recordings, good_pixels(effects, first.window), conditions.settings),
        conditions,
        [Screened(*pixel, value_e) for pixel, value_e in shown_e.items() if np.isfinite(value_e)],
        alike.moment,
        first.name,
        alike.star,
    )


# -- recordings that a diagnosis takes together ------------------------------------------------------

COMMON = {"pixel_scale_mas": "pixel scale", "derotator_angle_deg": "derotator angle"}
NIGHT_S = 12 * 3600.0  # gap between recordings from which they are of different nights


@dataclass(frozen=True)
class Alike:
    """Recordings of one moment with equal settings."""

    recordings: Sequence[Recording]  # in order of time
    moment: int = 0  # number of the star and night

    @property
    def first(self) -> Recording:
        return self.recordings[0]

    @property
    def star(self) -> str:
        """What the side-car or header calls it."""
        return self.first.acquisition.target

    @property
    def diversity_nm(self) -> float:
        """Size of the diversity [nm RMS]."""
        return float(np.linalg.norm(list(self.first.acquisition.diversity.values())))


def _by_setting(ingest: Product, input_name: str, *, apart: bool | None = None) -> list[Alike]:
    """Return the used frames of the input `input_name` of `ingest`, one group per setting and moment.

    The setting with the largest diversity comes first: errors of the diversity are stated for it. `apart`
    says whether every recording is of its own star or night, or all are of one; by default targets and
    times decide.
    """
    recordings = [r.accepted() for r in in_time_order(recordings_from_product(ingest, input_name))]
    together = "cubes diagnosed together may differ in star, night, focus, diversity and band only"
    require_common(recordings, COMMON, together)
    groups: dict[tuple, list[Recording]] = {}
    for recording, moment in zip(recordings, moments_of(recordings, apart), strict=True):
        told = recording.acquisition
        diversity = tuple(sorted((noll, nm) for noll, nm in told.diversity.items() if nm))
        setting = told.spectrum, diversity, _introduced_nm(recording), told.pupil_rotation_deg
        groups.setdefault((moment, *setting), []).append(recording)
    found = [Alike(alike, key[0]) for key, alike in groups.items()]
    return sorted(found, key=lambda alike: -alike.diversity_nm)


def moments_of(recordings: Sequence[Recording], apart: bool | None = None) -> list[int]:
    """Return the number of the star and night of every recording, from 0 in the order given.

    `recordings` in order of time; `apart`: see `_by_setting`.
    """
    if apart is not None:
        return [number if apart else 0 for number in range(len(recordings))]
    night, last_s = 0, float("nan")
    known: dict[tuple[str, int], int] = {}
    found = []
    for recording in recordings:
        night += bool(recording.start_unix_s - last_s > NIGHT_S)
        last_s = recording.start_unix_s
        found.append(known.setdefault((recording.acquisition.target, night), len(known)))
    return found


def _introduced_nm(recording: Recording) -> float:
    """Introduced defocus of all its used frames."""
    values = np.unique(recording.introduced_defocus_nm)
    if len(values) > 1:
        raise InputDataError(
            f"{recording.name}: the introduced defocus changes from frame to frame; a diagnosis takes "
            "recordings of one defocus each, or the recipe diagnose_ramp"
        )
    return float(values[0]) if len(values) else 0.0
