"""Stage `diagnose`: what the model of cubes or a ramp lacks, by name and size, and how the gap shrinks.

On a ramp these are errors of the focus stage by the estimates of `lift`, and of the light path.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.diagnosis.options import Options
from irlos_pipe.diagnosis.ramp import LightPathName, RampDiagnosis, RampName, compare, diagnose_ramp, ramp_gap
from irlos_pipe.diagnosis.records import Alternative, Gap
from irlos_pipe.diagnosis.verdict import EFFECT, Diagnosis
from irlos_pipe.diagnosis.view import Exposures, Moments, Screened, placed
from irlos_pipe.diagnosis.workflow import diagnose
from irlos_pipe.effects import CATALOGUE, Effect, EffectSet
from irlos_pipe.effects.image_model import NOTHING, ImageModel
from irlos_pipe.effects.planes import LensEffect
from irlos_pipe.estimate.cube import kurtosis_of_frames
from irlos_pipe.estimate.ramp_fit import RampFit
from irlos_pipe.frames.recording import Recording
from irlos_pipe.product.product import Product, declared
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
from irlos_pipe.stages.diagnose.stage import ARRAYS, Change, Config, DiagnoseResults, StepRow
from irlos_pipe.stages.ingest.stage import recordings_from_product, screened_e
from irlos_pipe.stages.lift.input import (
    Ramp,
    calibrated_ncpa_nm,
    effects_for_lift,
    fit_frames,
    ramp_model,
    read_ramp,
)
from irlos_pipe.stages.lift.stage import Config as LiftConfig
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


def run_on_ramp(ctx: StageContext, every: int) -> tuple[StageOutput, list[dict[str, Any]]]:
    """Diagnose the ramp that `lift` estimated; `ctx` has its product, one frame in `every` is held out.

    Returns the output, and the entries that what was found adds to the model's effects.
    """
    began = time.perf_counter()
    ramp = read_ramp(ctx, ctx.config.input)
    lift = ctx.products["lift"]
    held_out = frames_held_out(ramp.commanded_nm, every)
    ctx, lens, fit = _preferred_lens(ctx, ramp, held_out, ctx.config.sure_sigma)
    estimated = fit.defocus_nm if lens and fit else np.asarray(lift.arrays["defocus_nm"].value, float)
    try:
        result = diagnose_ramp(ramp.commanded_nm, estimated, ~held_out, ctx.config.sure_sigma)
    except ValueError as problem:
        raise InputDataError(f"ramp of {len(ramp.recordings)} recordings: {problem}") from None
    if lens and not lens.comparison.complete:  # the stage is not to blame for errors of the model
        result = replace(result, names=[], nearest=result.names or result.nearest)
    corrected = result.introduced_nm(ramp.commanded_nm)
    model, modes = _lift_model(ctx, ramp, lift) if fit is None else (fit.model.general, fit.result.zernike_nm)
    gap = ramp_gap(model, ramp.data, modes, ramp.commanded_nm, corrected, held_out)
    if lens and not result.names:
        gap = replace(gap, before=lens.comparison.gap[0], after=lens.comparison.gap[1])
    results = _results(ramp, result, lens, gap, estimated, corrected, time.perf_counter() - began)
    output = StageOutput(
        declared(
            ARRAYS,
            {"commanded_nm": ramp.commanded_nm, "corrected_nm": corrected, "estimated_nm": estimated},
        ),
        results,
        checks_of(results),
        summary=[
            f"diagnosis       {EFFECT if lens else result.verdict}: {sentence(result, lens)}",
            f"  gap             {gap.before:.4f} -> {gap.after:.4f}, floor {gap.floor:.4f} (held-out "
            f"frames), χ²/ν of the offsets {result.chi2_nu[0]:.2f} -> {result.chi2_nu[1]:.2f}",
        ],
    )
    lenses = [{lens.effect.name: lens.public}] if lens else []
    return output, [*lenses, *({one.name: one.public} for one in result.names)]


def frames_held_out(commanded_nm: np.ndarray, every: int) -> np.ndarray:
    """Return which frames no fit may see, (frames,) of bool.

    Of every visit each `every`-th frame, or of all frames where visits are shorter than that. A visit is a
    run of equal `commanded_nm`, (frames,).
    """
    starts = np.flatnonzero(np.diff(commanded_nm, prepend=np.nan) != 0)
    visits = np.split(np.arange(len(commanded_nm)), starts[1:])
    within = np.concatenate([np.arange(len(visit)) for visit in visits])
    count = within if within.max() >= every - 1 else np.arange(len(commanded_nm))
    return count % every == every - 1


def _lift_model(ctx: StageContext, ramp: Ramp, lift: Product) -> tuple[ImageModel, torch.Tensor]:
    """The model that `lift` had, and its estimates (frames, modes)."""
    config = lift.config
    ncpa_nm = calibrated_ncpa_nm(ctx) if config["calibrated"] else {}
    model = ramp_model(ctx, ramp, tuple(config["modes"]), ncpa_nm)
    kernel, recording = config["object_sigma_mas"], ramp.recordings[0]
    effects = effects_for_lift(ctx, recording, config["halo"], kernel, calibrated=config["calibrated"])
    free = EffectSet(effects, model.grids)
    held = ImageModel(model, free.held(free.starts) if free.parameters else free.held(NOTHING))
    return held, torch.as_tensor(np.nan_to_num(np.asarray(lift.arrays["zernike_nm"].value, float)))


def _results(
    ramp: Ramp,
    result: RampDiagnosis,
    lens: LightPathName | None,
    gap: Gap,
    estimated: np.ndarray,
    corrected: np.ndarray,
    seconds: float,
) -> DiagnoseResults:
    errors = [float(np.sqrt(np.nanmean((estimated - one) ** 2))) for one in (ramp.commanded_nm, corrected)]
    return DiagnoseResults(
        verdict=EFFECT if lens else result.verdict,
        sentence=sentence(result, lens),
        steps=[*_lens_steps(lens), *(_step(one, gap) for one in result.names)],
        nearest=_step(result.nearest[0], gap) if result.nearest else None,
        gap=gap,
        unexplained=result.verdict == "unknown" or (lens is not None and not lens.comparison.complete),
        untestable=list(result.untestable),
        mdb=result.smallest,
        model=MODEL_FILE,
        chi2_nu=Change.of(result.chi2_nu),
        defocus_error_nm=Change.of(errors),
        seconds=seconds,
    )


def _lens_steps(lens: LightPathName | None) -> list[StepRow]:
    if lens is None:
        return []
    found = lens.comparison
    return [
        StepRow(
            effect=lens.effect.name,
            parameters=lens.public,
            phrase=lens.phrase,
            shown=lens.public,
            significance=found.significance,
            explained=1 - (found.chi2_nu[1] - 1) / (found.chi2_nu[0] - 1),
            gap_before=found.gap[0],
            gap_after=found.gap[1],
        )
    ]


def _step(one: RampName, gap: Gap) -> StepRow:
    reason = "their courses over the visits are alike"
    return StepRow.filled_from(
        one,
        effect=one.name,
        indistinguishable=[other.name for other in one.alternatives],
        alternatives=[
            Alternative(name=other.name, reason=reason, separated_by=other.separated_by)
            for other in one.alternatives
        ],
        parameters=one.public,
        sigma=one.public_sigma,
        shown=one.public,
        shown_sigma=one.public_sigma,
        gap_before=gap.before,
        gap_after=gap.after,
        ranking=[],
    )


def sentence(result: RampDiagnosis, lens: LightPathName | None = None) -> str:
    """Return the verdict as a sentence; `lens` is the lens effect that the images prefer."""
    if lens is not None:
        if not lens.comparison.complete:
            near = " and ".join(one.phrase for one in result.nearest)
            left = f"Held-out frames still have χ²/ν {lens.comparison.chi2_nu[1]:.1f}"
            more = f"; it would be {near}" if near else ""
            return (
                f"The images need {lens.phrase}. {left}: something else is missing in them, "
                f"and no error of the focus stage can be named{more}."
            )
        return f"The images need {lens.phrase}. With it: {_stage_sentence(result)}"
    return _stage_sentence(result)


def _stage_sentence(result: RampDiagnosis) -> str:
    if result.verdict == "unknown":
        near = " and ".join(one.phrase for one in result.nearest)
        nearest = f"; the nearest is {near}" if near else ""
        return f"The ramp does not follow its offsets, and no error of the focus stage explains it{nearest}."
    if not result.names:
        return "The focus stage does what is commanded."
    return f"The ramp needs {' and '.join(one.phrase for one in result.names)}; nothing else is missing."


# -- what introduced defocus is: effects of lenses, from fits of the images --------------------------


def _preferred_lens(
    ctx: StageContext, ramp: Ramp, held_out: np.ndarray, sure: float
) -> tuple[StageContext, LightPathName | None, RampFit | None]:
    """Return the lens effect that the images prefer, if there is one, and the fit that it was found with.

    The context returned has the effect in its model. The fit is of the whole ramp; None where nothing had to
    be compared and the frames share nothing fitted.
    """
    present = {entry.name for entry in ctx.model.entries()}
    conditions = conditions_of(ctx.instrument, ctx.model, ramp.recordings[0])
    candidates: list[LensEffect] = []
    for name, kind in CATALOGUE.items():
        if name not in present and issubclass(kind, LensEffect):
            with suppress(ValueError):  # it means nothing for this ramp
                candidates.append(kind.under(conditions))
    if not candidates and not ctx.products["lift"].config["common_modes"]:
        return ctx, None, None
    plain = _fitted(ctx, ramp, held_out)
    best: tuple[StageContext, LightPathName | None, RampFit] = (ctx, None, plain)
    for effect in candidates:
        values = [one.start for one in effect.parameters]
        entry = {effect.name: effect.describe(np.array(values))}
        other = replace(ctx, model=ctx.model.model_copy(update={"effects": (*ctx.model.effects, entry)}))
        fit = _fitted(other, ramp, held_out)
        comparison = compare(ramp.data, plain, fit, held_out)
        known = best[1].comparison.significance if best[1] else 0.0
        if comparison.favours(sure) and comparison.significance > known:
            best = other, LightPathName(effect, values, comparison), fit
    return best


def _fitted(ctx: StageContext, ramp: Ramp, held_out: np.ndarray) -> RampFit:
    """LIFT as it was asked for; what all frames share comes from the frames that are not held out."""
    config = LiftConfig(**ctx.products["lift"].config)
    lift = replace(ctx, config=config)
    return fit_frames(lift, ramp, calibrated=config.calibrated, halo=config.halo, seen=~held_out)
