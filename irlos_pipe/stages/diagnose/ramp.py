"""The stage `diagnose` on a ramp: errors of the focus stage, from the estimates of `lift`."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.diagnose.held_out import Gap
from irlos_pipe.diagnose.ramp.diagnosis import RampDiagnosis, RampName, diagnose_ramp
from irlos_pipe.diagnose.ramp.gap import ramp_gap
from irlos_pipe.effects import EffectSet
from irlos_pipe.effects.effect_set import NOTHING
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.lift.input import Ramp, calibrated_ncpa_nm, effects_for_lift, ramp_model, read_ramp


def run_on_ramp(ctx: StageContext, every: int) -> tuple[StageOutput, list[dict[str, Any]]]:
    """Diagnose the ramp that `lift` estimated; one frame in `every` is held out.

    Returns
    -------
    StageOutput
    list of dict
        Entries that what was found adds to the model's effects.
    """
    began = time.perf_counter()
    ramp = read_ramp(ctx, ctx.config.input)
    lift = ctx.products["lift"]
    estimated = np.asarray(lift.arrays["defocus_nm"].value, float)
    held_out = frames_held_out(ramp.commanded_nm, every)
    try:
        result = diagnose_ramp(ramp.commanded_nm, estimated, ~held_out, ctx.config.sure_sigma)
    except ValueError as problem:
        raise InputDataError(f"ramp of {len(ramp.recordings)} recordings: {problem}") from None
    corrected = result.introduced_nm(ramp.commanded_nm)
    gap = _gap(ctx, ramp, lift, corrected, held_out)
    results = _results(ramp, result, gap, estimated, corrected) | {"seconds": time.perf_counter() - began}
    output = StageOutput(_arrays(ramp, estimated, corrected), results, summary=_summary(result, gap))
    return output, [entry(one) for one in result.names]


def frames_held_out(commanded_nm: np.ndarray, every: int) -> np.ndarray:
    """Frames that no fit may see, (frames,): of every visit each `every`-th, or of all frames if visits
    are shorter than that."""
    starts = np.flatnonzero(np.diff(commanded_nm, prepend=np.nan) != 0)
    visits = np.split(np.arange(len(commanded_nm)), starts[1:])
    within = np.concatenate([np.arange(len(visit)) for visit in visits])
    count = within if within.max() >= every - 1 else np.arange(len(commanded_nm))
    return count % every == every - 1


def _gap(ctx: StageContext, ramp: Ramp, lift, corrected_nm: np.ndarray, held_out: np.ndarray) -> Gap:
    """On images, with the model that `lift` had."""
    config = lift.config
    ncpa_nm = calibrated_ncpa_nm(ctx) if config["calibrated"] else {}
    model = ramp_model(ctx, ramp, tuple(config["modes"]), ncpa_nm)
    kernel, recording = config["object_sigma_mas"], ramp.recordings[0]
    effects = effects_for_lift(ctx, recording, config["halo"], kernel, calibrated=config["calibrated"])
    free = EffectSet(effects, model.grids)
    held = ImageModel(model, free.held(free.starts) if free.parameters else free.held(NOTHING))
    modes = torch.as_tensor(np.nan_to_num(np.asarray(lift.arrays["zernike_nm"].value, float)))
    return ramp_gap(held, ramp.data, modes, ramp.commanded_nm, corrected_nm, held_out)


def _results(
    ramp: Ramp, result: RampDiagnosis, gap: Gap, estimated: np.ndarray, corrected: np.ndarray
) -> dict[str, Any]:
    errors = [_rms(estimated - introduced) for introduced in (ramp.commanded_nm, corrected)]
    return {
        "verdict": result.verdict,
        "sentence": sentence(result),
        "steps": [_step(one, gap) for one in result.names],
        "nearest": _step(result.nearest[0], gap) if result.nearest else None,
        "gap": {"before": gap.before, "after": gap.after, "floor": gap.floor, "shrink": gap.shrink},
        "unexplained": result.verdict == "unknown",
        "untestable": list(result.untestable),
        "mdb": result.smallest,
        "model": "model.yaml",
        "chi2_nu": dict(zip(("before", "after"), result.chi2_nu, strict=True)),
        "defocus_error_nm": dict(zip(("before", "after"), errors, strict=True)),
    }


def entry(one: RampName) -> dict[str, Any]:
    """The effect as the section `model` of a recipe has it."""
    return {one.name: one.public}


def _step(one: RampName, gap: Gap) -> dict[str, Any]:
    reason = "their courses over the visits are alike"
    return {
        "effect": one.name,
        "indistinguishable": [other.name for other in one.alternatives],
        "alternatives": [
            {"name": other.name, "reason": reason, "separated_by": other.separated_by}
            for other in one.alternatives
        ],
        "parameters": one.public,
        "sigma": one.effect.describe([one.sigma]),
        "significance": one.significance,
        "explained": one.explained,
        "gap_before": gap.before,
        "gap_after": gap.after,
        "ranking": [],
    }


def sentence(result: RampDiagnosis) -> str:
    """The verdict in the words of an engineer."""
    if result.verdict == "unknown":
        near = " and ".join(one.phrase for one in result.nearest)
        nearest = f"; the nearest is {near}" if near else ""
        return f"The ramp does not follow its offsets, and no error of the focus stage explains it{nearest}."
    if not result.names:
        return "The focus stage does what it is told."
    return f"The ramp wants {' and '.join(one.phrase for one in result.names)}; nothing else is missing."


def _arrays(ramp: Ramp, estimated: np.ndarray, corrected: np.ndarray) -> dict[str, Quantity]:
    return {
        "commanded_nm": Quantity(
            ramp.commanded_nm, "nm", "introduced defocus as told, frames in order of time"
        ),
        "corrected_nm": Quantity(corrected, "nm", "the same with what was found"),
        "estimated_nm": Quantity(estimated, "nm", "estimate of every frame"),
    }


def _summary(result: RampDiagnosis, gap: Gap) -> list[str]:
    return [
        f"diagnosis       {result.verdict}: {sentence(result)}",
        f"  gap             {gap.before:.4f} -> {gap.after:.4f}, floor {gap.floor:.4f} (held-out frames), "
        f"χ²/ν of the offsets {result.chi2_nu[0]:.2f} -> {result.chi2_nu[1]:.2f}",
    ]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
