"""Stage `diagnose`: what the model of cubes or a ramp lacks, by name and size, and how the gap shrinks.

On a ramp these are errors of the focus stage by the estimates of `lift`, and of the light path.
"""

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import yaml

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.modes import HIGHEST_REPORTED_NOLL
from irlos_pipe.diagnosis.ramp import LightPathName, RampDiagnosis, RampName, compare, diagnose_ramp, ramp_gap
from irlos_pipe.diagnosis.records import Alternative, Gap, Options
from irlos_pipe.diagnosis.sharing import Together
from irlos_pipe.diagnosis.verdict import EFFECT, UNKNOWN, Diagnosis, Pictures, Step, sentence
from irlos_pipe.diagnosis.view import Exposures, Moments, Screened, placed
from irlos_pipe.diagnosis.workflow import diagnose
from irlos_pipe.effects import CATALOGUE, Effect, EffectSet, FixedEffect
from irlos_pipe.effects.image_model import NOTHING, ImageModel
from irlos_pipe.effects.planes import LensEffect
from irlos_pipe.estimate.cube import kurtosis_of_frames
from irlos_pipe.estimate.ramp_fit import RampFit
from irlos_pipe.frames.recording import Recording, star_position
from irlos_pipe.optics.image_quality import power_spectrum, quality_curves
from irlos_pipe.optics.psf_settings import PsfSettings
from irlos_pipe.optics.wavefront import MapSize
from irlos_pipe.product.product import Check, Product, Quantity, declared
from irlos_pipe.stages.base import ModelConfig, StageContext, StageOutput
from irlos_pipe.stages.calibrate.quality import frame_checks
from irlos_pipe.stages.diagnose.stage import (
    ARRAYS,
    AdjustedRow,
    Change,
    Config,
    DiagnoseResults,
    FrameCounts,
    ModesChange,
    StepRow,
)
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
from irlos_pipe.stages.model.untested import LOOKED_AT_ELSEWHERE, untested_by_cubes

MODEL_FILE = "model.yaml"
EXPECTED_FITS = 11  # fits that one cube takes, for the progress bar


def run(ctx: StageContext[Config]) -> StageOutput:
    """Diagnose the recipe's input: behind the stage `lift` a ramp, else cubes of one wavefront."""
    output, entries = _on_ramp(ctx) if "lift" in ctx.products else _on_cubes(ctx)
    return replace(output, files={MODEL_FILE: model_yaml(ctx.model, entries)})


def _on_cubes(ctx: StageContext[Config]) -> tuple[StageOutput, list[dict[str, Any]]]:
    """The output, and the entries that what was found adds to the model's effects."""
    apart = {"auto": None, "together": False, "apart": True}[ctx.config.recordings]
    groups = _by_setting(ctx.products["ingest"], ctx.config.input, apart=apart)
    of_groups = [psf_settings(ctx.instrument, ctx.model, alike.first) for alike in groups]
    result = _diagnose(ctx, groups)
    results = diagnose_results(result, groups[0].first.acquisition.diversity)
    checks = checks_of(results)
    for alike, settings in zip(groups, of_groups, strict=True):
        window = alike.first.window
        frames = pooled_frames(alike.recordings, np.ones(window, bool), settings)
        checks += frame_checks(kurtosis_of_frames(frames), frames.motion, window)
    arrays = diagnose_arrays(result) | quality_arrays(result.pictures, of_groups[0])
    return StageOutput(arrays, results, checks, summary=summary_lines(result)), model_entries(result)


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
    model = placed({one: image_effects(some) for one, some in effects.items()}, Moments.of(exposures))
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
        first.acquisition.target,
    )


# -- recordings that a diagnosis takes together ------------------------------------------------------

COMMON = {"pixel_scale_mas": "pixel scale", "derotator_angle_deg": "derotator angle"}
NIGHT_S = 12 * 3600.0  # gap between recordings from which they are of different nights


@dataclass(frozen=True)
class Alike:
    """Recordings of one moment with equal settings."""

    recordings: Sequence[Recording]  # in order of time
    moment: int  # number of the star and night

    @property
    def first(self) -> Recording:
        return self.recordings[0]


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
    return sorted(found, key=lambda alike: -np.linalg.norm([*alike.first.acquisition.diversity.values()]))


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


# -- what is reported of cubes: results, check, arrays, lines for the terminal -------------------------


def diagnose_results(result: Diagnosis, diversity_nm: Mapping[int, float]) -> DiagnoseResults:
    """Return the `result` of a diagnosis of cubes that were taken with a diversity `diversity_nm`."""
    modes = [_by_noll(result, one) for one in result.modes_nm]
    return DiagnoseResults.filled_from(
        result,
        untested=untested_by_cubes(diversity_nm, LOOKED_AT_ELSEWHERE),
        sentence=sentence(result),
        steps=[_step(step, result.together) for step in result.steps],
        nearest=None if result.nearest is None else _step(result.nearest, result.together),
        open_facts={one.name: one.base.describe(one.values) for one in result.open_facts},
        adjusted=[
            AdjustedRow.filled_from(one, effect=one.label, parameters=one.public) for one in result.adjusted
        ],
        tried=list(result.tried),
        untestable=list(result.untestable),
        recordings=list(result.together.stars) if result.together else [],
        sharing=list(result.together.sharing.values()) if result.together else [],
        second_recording=dict(result.advice),
        model=MODEL_FILE,
        fine_structure=result.fine,
        chi2_nu=Change.of(result.chi2_nu),
        excess_sigma=Change.of(result.excess_sigma),
        frames=FrameCounts(training=result.frames[0], held_out=result.frames[1]),
        added_wavefront=MapSize.of(result.pictures.added_opd_nm),
        zernike_nm=ModesChange(before=modes[0], after=modes[1]),
        sigma_nm=_by_noll(result, result.modes_sigma_nm),
        seconds=round(result.seconds, 3),
    )


def checks_of(results: DiagnoseResults) -> list[Check]:
    """Return the check of a diagnosis: that the model with what was named in `results` lacks nothing."""
    explained = results.verdict != UNKNOWN and not results.unexplained
    grade = f", {results.grade}" if results.grade and results.grade != results.verdict else ""
    rest = results.rest.text if results.rest else ""
    left = "" if explained else results.why_unknown or rest  # the whole sentence stands beside it
    message = f"{results.verdict}{grade}: {left or results.sentence}"
    return [Check("everything explained", float(explained), "", 1.0, None, message)]


def _step(step: Step, together: Together | None) -> StepRow:
    return StepRow.filled_from(
        step,
        effect=step.label,
        indistinguishable=[other.name for other in step.alternatives],
        alternatives=list(step.alternatives),
        parameters=step.public,
        shown=step.shown or step.public,
        shown_sigma=step.shown_sigma or step.sigma,
        held_out_z=step.preference,
        gap_before=step.gap.before,
        gap_after=step.gap.after,
        ranking=list(step.ranking),
        recordings=[] if together is None else step.found_in(together.moments),
    )


def _by_noll(result: Diagnosis, values: np.ndarray) -> dict[int, float]:
    both = zip(result.nolls, values.tolist(), strict=True)
    return {noll: value for noll, value in both if noll <= HIGHEST_REPORTED_NOLL}


def diagnose_arrays(result: Diagnosis) -> dict[str, Quantity]:
    """Return images, maps and modes of a diagnosis of cubes."""
    pictures, (before, after) = result.pictures, result.modes_nm
    values = {
        "measured_e": (pictures.measured_e, np.where(np.isfinite(pictures.sigma_e), pictures.sigma_e, 0.0)),
        "before_e": pictures.before_e,
        "after_e": pictures.after_e,
        "leading_mode": pictures.leading,
        "added_opd_nm": pictures.added_opd_nm,
        "added_amplitude": pictures.added_amplitude,
        "noll": result.nolls,
        "zernike_before_nm": before,
        "zernike_after_nm": (after, result.modes_sigma_nm),
    }
    return declared(ARRAYS, values)


def summary_lines(result: Diagnosis) -> list[str]:
    """Return the lines for the terminal."""
    gap, held_out = result.gap, result.held_out
    lines = [f"diagnosis       {result.verdict}: {sentence(result)}"]
    lines.append(
        f"  gap             {gap.before:.4f} -> {gap.after:.4f}, floor {gap.floor:.4f} "
        f"(held-out {held_out}), χ²/ν {result.chi2_nu[0]:.2f} -> {result.chi2_nu[1]:.2f}, "
        f"{result.seconds:.0f} s"
    )
    if result.unexplained:
        lines.append(f"  left            {result.rest.text}")
    for step in result.steps:
        if step.unusual:
            lines.append(f"  unusual         {step.label}: {', '.join(step.unusual)} beyond what is usual")
    if result.open_facts:
        lines.append(f"  free as well    {', '.join(one.name for one in result.open_facts)} in {MODEL_FILE}")
    lines.append(f"  noise           {result.noise.text}")
    fine = result.fine
    lines.append(f"  finer than D/λ  {fine.ratio:.2f} × what noise leaves there, {fine.significance:.1f} σ")
    return lines


# -- OTF, encircled energy, and power of what is left, measured and predicted ------------------------


def quality_arrays(pictures: Pictures, settings: PsfSettings) -> dict[str, Quantity]:
    """Return the curves of the mean held-out image and of its predictions, `pictures` under `settings`.

    Pixels that are not used hold the prediction after in all three. Light is that of the window.
    """
    used = np.isfinite(pictures.sigma_e) & (pictures.sigma_e > 0)
    resolution_px, scale_mas = settings.resolution_px, settings.pixel_scale_mas
    images = {"measured": pictures.measured_e, "before": pictures.before_e, "after": pictures.after_e}
    centre = star_position(np.nan_to_num(pictures.after_e))
    whole = {name: np.where(used, image, pictures.after_e) for name, image in images.items()}
    arrays = quality_curves(whole, centre, resolution_px, scale_mas, of_window=True)
    for name in ("before", "after"):
        left = np.where(
            used, (pictures.measured_e - images[name]) / np.where(used, pictures.sigma_e, 1), np.nan
        )
        power = power_spectrum(left, resolution_px)
        arrays |= {"left_frequency": power.at, f"left_power_{name}": power.value}
    return declared(ARRAYS, arrays)


# -- the model with what was found -------------------------------------------------------------


def model_yaml(model: ModelConfig, entries: Sequence[dict[str, Any]]) -> bytes:
    """Return the section `model` of a recipe with `entries` added to its effects, as YAML."""
    section = model.model_dump(mode="json")
    section["effects"] = _with_one_list_of_pixels([*section["effects"], *entries])
    return yaml.safe_dump(section, sort_keys=False, allow_unicode=True).encode()


def _with_one_list_of_pixels(effects: list[Any]) -> list[Any]:
    """Entries of which a single one lists all bad pixels."""
    (name,) = (name for name, kind in CATALOGUE.items() if kind.found_by == "pixels")
    listed = [entry[name]["pixels"] for entry in effects if isinstance(entry, dict) and name in entry]
    if len(listed) < 2:
        return effects
    others = [entry for entry in effects if not (isinstance(entry, dict) and name in entry)]
    pixels = sorted({tuple(pixel) for part in listed for pixel in part})
    return [*others, {name: {"pixels": [list(pixel) for pixel in pixels]}}]


def model_entries(result: Diagnosis) -> list[dict[str, Any]]:
    """Return what a diagnosis found, adjusted or leaves free, common to its recordings, as entries."""
    found = [one.effect for one in (*result.steps, *result.adjusted)]
    return [recipe_entry(one) for one in (*found, *result.open_facts) if one.acts_in is None]


def recipe_entry(effect: FixedEffect) -> dict[str, Any]:
    """Return an effect as an entry of the section: values to start from, fitted where that helps."""
    kind, public = CATALOGUE[effect.name], effect.base.describe(effect.values)
    values = {p.name: public[p.name] for p in kind.public if p.name in public}
    # tables by integer, as in the YAML of a recipe
    values |= {key: {int(i): one for i, one in v.items()} for key, v in values.items() if isinstance(v, dict)}
    words = {o.name: getattr(effect.base, o.name) for o in kind.options if o.kind == "word"}
    options = {name: word for name, word in words.items() if word}
    return {effect.name: values | options | ({"fit": True} if kind.found_by == "score" else {})}


# -- a ramp -----------------------------------------------------------------------------------


def _on_ramp(ctx: StageContext[Config]) -> tuple[StageOutput, list[dict[str, Any]]]:
    """The output of the ramp that `lift` estimated, and the entries that are added to the model's effects."""
    began, every = time.perf_counter(), round(1 / ctx.config.held_out)
    ramp = read_ramp(ctx, ctx.config.input)
    lift = ctx.products["lift"]
    held_out = frames_held_out(ramp.commanded_nm, every)
    ctx, lens, fit = _preferred_lens(ctx, ramp, held_out, ctx.config.sure_sigma)
    estimated = fit.defocus_nm if lens and fit else np.asarray(lift.arrays["defocus_nm"].value, float)
    with ramp.refused():
        result = diagnose_ramp(ramp.commanded_nm, estimated, ~held_out, ctx.config.sure_sigma)
    if lens and not lens.comparison.complete:  # the stage is not to blame for errors of the model
        result = replace(result, names=[], nearest=result.names or result.nearest)
    corrected = result.introduced_nm(ramp.commanded_nm)
    model, modes = _lift_model(ctx, ramp, lift) if fit is None else (fit.model.general, fit.result.zernike_nm)
    gap = ramp_gap(model, ramp.data, modes, ramp.commanded_nm, corrected, held_out)
    if lens and not result.names:
        gap = replace(gap, before=lens.comparison.gap[0], after=lens.comparison.gap[1])
    arrays = {"commanded_nm": ramp.commanded_nm, "corrected_nm": corrected, "estimated_nm": estimated}
    errors = [float(np.sqrt(np.nanmean((estimated - one) ** 2))) for one in (ramp.commanded_nm, corrected)]
    results = DiagnoseResults(
        verdict=EFFECT if lens else result.verdict,
        sentence=_ramp_sentence(result, lens),
        steps=[*_lens_steps(lens), *(_ramp_step(one, gap) for one in result.names)],
        nearest=_ramp_step(result.nearest[0], gap) if result.nearest else None,
        gap=gap,
        unexplained=result.verdict == UNKNOWN or (lens is not None and not lens.comparison.complete),
        untestable=list(result.untestable),
        mdb=result.smallest,
        model=MODEL_FILE,
        chi2_nu=Change.of(result.chi2_nu),
        defocus_error_nm=Change.of(errors),
        seconds=time.perf_counter() - began,
    )
    lines = [
        f"diagnosis       {results.verdict}: {results.sentence}",
        f"  gap             {gap.before:.4f} -> {gap.after:.4f}, floor {gap.floor:.4f} (held-out "
        f"frames), χ²/ν of the offsets {result.chi2_nu[0]:.2f} -> {result.chi2_nu[1]:.2f}",
    ]
    lenses = [{lens.effect.name: lens.public}] if lens else []
    entries = [*lenses, *({one.name: one.public} for one in result.names)]
    return StageOutput(declared(ARRAYS, arrays), results, checks_of(results), summary=lines), entries


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


def _lens_steps(lens: LightPathName | None) -> list[StepRow]:
    if lens is None:
        return []
    found = lens.comparison
    step = StepRow(
        effect=lens.effect.name,
        parameters=lens.public,
        phrase=lens.phrase,
        shown=lens.public,
        significance=found.significance,
        explained=1 - (found.chi2_nu[1] - 1) / (found.chi2_nu[0] - 1),
        gap_before=found.gap[0],
        gap_after=found.gap[1],
    )
    return [step]


def _ramp_step(one: RampName, gap: Gap) -> StepRow:
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


def _ramp_sentence(result: RampDiagnosis, lens: LightPathName | None) -> str:
    """Return the verdict as a sentence; `lens` is the lens effect that the images prefer."""
    near = " and ".join(one.phrase for one in result.nearest)
    if lens is not None and not lens.comparison.complete:
        left = f"Held-out frames still have χ²/ν {lens.comparison.chi2_nu[1]:.1f}"
        more = f"; it would be {near}" if near else ""
        return (
            f"The images need {lens.phrase}. {left}: something else is missing in them, "
            f"and no error of the focus stage can be named{more}."
        )
    stage = f"The ramp needs {' and '.join(one.phrase for one in result.names)}; nothing else is missing."
    if result.verdict == UNKNOWN:
        nearest = f"; the nearest is {near}" if near else ""
        stage = f"The ramp does not follow its offsets, and no error of the focus stage explains it{nearest}."
    elif not result.names:
        stage = "The focus stage does what is commanded."
    return f"The images need {lens.phrase}. With it: {stage}" if lens else stage


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
    return fit_frames(replace(ctx, config=LiftConfig(**ctx.products["lift"].config)), ramp, seen=~held_out)
