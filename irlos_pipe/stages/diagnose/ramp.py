"""Stage `diagnose` on a ramp: errors of the focus stage by the estimates of `lift`, and of the light path."""

import time
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.diagnosis.ramp import LightPathName, RampDiagnosis, RampName, compare, diagnose_ramp, ramp_gap
from irlos_pipe.diagnosis.records import Alternative, Gap
from irlos_pipe.diagnosis.verdict import EFFECT
from irlos_pipe.effects import CATALOGUE, EffectSet
from irlos_pipe.effects.image_model import NOTHING, ImageModel
from irlos_pipe.effects.planes import LensEffect
from irlos_pipe.estimate.ramp_fit import RampFit
from irlos_pipe.product.product import Product, declared
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.diagnose.output import MODEL_FILE, checks_of
from irlos_pipe.stages.diagnose.stage import ARRAYS, Change, DiagnoseResults, StepRow
from irlos_pipe.stages.lift.fit import fit_frames
from irlos_pipe.stages.lift.input import Ramp, calibrated_ncpa_nm, effects_for_lift, ramp_model, read_ramp
from irlos_pipe.stages.lift.stage import Config as LiftConfig
from irlos_pipe.stages.model.effects import conditions_of


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
