"""The stage `diagnose` on a ramp: effects on what introduced defocus is, from fits of the images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from irlos_pipe.diagnosis.ramp.light_path import LightPathName, compare
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.effects.planes import LensEffect
from irlos_pipe.estimate.ramp_fit import RampFit
from irlos_pipe.stages.base import StageContext
from irlos_pipe.stages.lift.fit import fit_frames
from irlos_pipe.stages.lift.input import Ramp
from irlos_pipe.stages.lift.stage import Config as LiftConfig
from irlos_pipe.stages.model.effects import conditions_of


def lens_candidates(ctx: StageContext, ramp: Ramp) -> list[LensEffect]:
    """Return the lens effects that mean something for this `ramp` and that the recipe's model lacks."""
    present = {entry.name for entry in ctx.model.entries()}
    conditions = conditions_of(ctx.instrument, ctx.model, ramp.recordings[0])
    found = []
    for name, kind in CATALOGUE.items():
        if name in present or not issubclass(kind, LensEffect):
            continue
        try:
            found.append(kind.under(conditions))
        except ValueError:
            continue
    return found


def wanted_lens(
    ctx: StageContext, ramp: Ramp, held_out: np.ndarray, sure: float
) -> tuple[StageContext, LightPathName | None, RampFit | None]:
    """Return the lens effect that the images want, if there is one, and the fit that it was found with.

    Parameters
    ----------
    ctx : StageContext
        With the product of `lift`.
    ramp : Ramp
    held_out : ndarray of bool, (frames,)
    sure : float
        Significance of a detection.

    Returns
    -------
    StageContext
        Its model has the effect.
    LightPathName or None
    RampFit or None
        The ramp fitted again; None where nothing had to be compared and the frames share nothing fitted.
    """
    candidates = lens_candidates(ctx, ramp)
    if not candidates and not ctx.products["lift"].config["common_modes"]:
        return ctx, None, None
    plain = _fitted(ctx, ramp, held_out)
    best: tuple[StageContext, LightPathName | None, RampFit] = (ctx, None, plain)
    for effect in candidates:
        values = [one.start for one in effect.parameters]
        other = _with_effect(ctx, effect, values)
        fit = _fitted(other, ramp, held_out)
        comparison = compare(ramp.data, plain, fit, held_out)
        known = best[1].comparison.significance if best[1] else 0.0
        if comparison.favours(sure) and comparison.significance > known:
            best = other, LightPathName(effect, values, comparison), fit
    return best


def _with_effect(ctx: StageContext, effect: LensEffect, values: list[float]) -> StageContext:
    entry = {effect.name: effect.describe(np.array(values))}
    return replace(ctx, model=ctx.model.model_copy(update={"effects": (*ctx.model.effects, entry)}))


def _fitted(ctx: StageContext, ramp: Ramp, held_out: np.ndarray) -> RampFit:
    """LIFT as it was asked for; what all frames share comes from the frames that are not held out."""
    config = LiftConfig(**ctx.products["lift"].config)
    lift = replace(ctx, config=config)
    return fit_frames(lift, ramp, calibrated=config.calibrated, halo=config.halo, seen=~held_out)
