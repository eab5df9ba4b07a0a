"""Stage `diagnose`: what the model of cubes or a ramp lacks, by name and size, and how the gap shrinks."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
import yaml
from pydantic import Field

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.diagnose.decide import Options
from irlos_pipe.diagnose.held_out import Gap
from irlos_pipe.diagnose.second_recording import Advice
from irlos_pipe.diagnose.sentence import sentence
from irlos_pipe.diagnose.verdict import Diagnosis, Step
from irlos_pipe.diagnose.view import Exposures
from irlos_pipe.diagnose.workflow import diagnose
from irlos_pipe.effects import CATALOGUE, Effect
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.frames.recording import Recording
from irlos_pipe.product.product import Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.diagnose.input import by_setting, introduced_nm, screened_pixels
from irlos_pipe.stages.diagnose.ramp import run_on_ramp
from irlos_pipe.stages.model.effects import conditions_of, good_pixels, image_effects, model_effects
from irlos_pipe.stages.model.light_path import pooled_images

NAME = "diagnose"
VERSION = 8
NEEDS = ("ingest",)
READS = ("ingest", "calibrate", "lift")
MODEL_FILE = "model.yaml"
FEWEST_FRAMES = 16  # scatter means nothing with less
REPORTED = 30  # highest Noll mode in the results
EXPECTED_FITS = 11  # of one cube, for the progress bar


class Config(StageConfig):
    """Settings of the diagnosis."""

    input: str = Field("cube", description="recipe input that holds the cubes, or the ramp")
    highest_noll: int = Field(
        66, ge=4, le=231, description="modes 2 to this belong to every model; beyond: high_order_ncpa"
    )
    held_out: float = Field(0.25, gt=0.05, le=0.5, description="part of the frames that no fit sees")
    most_names: int = Field(4, ge=1, le=10, description="names at which to stop")
    sure_sigma: float = Field(5.0, ge=3, le=20, description="significance of a detection")


def run(ctx: StageContext) -> StageOutput:
    """Diagnose the recipe's input: behind the stage `lift` a ramp, else cubes of one wavefront."""
    if "lift" in ctx.products:
        output, entries = run_on_ramp(ctx, round(1 / ctx.config.held_out))
        return replace(output, files={MODEL_FILE: _model_yaml(ctx, entries)})
    result = _diagnose(ctx, by_setting(ctx.products["ingest"], ctx.config.input))
    model = _model_yaml(ctx, [_entry(step) for step in result.steps])
    return StageOutput(_arrays(result), _results(result), files={MODEL_FILE: model}, summary=_summary(result))


def _diagnose(ctx: StageContext, settings: list[list[Recording]]) -> Diagnosis:
    config = ctx.config
    effects = model_effects(ctx.instrument, ctx.model, settings[0][0], config.highest_noll)
    exposures = [_exposures(ctx, alike, effects) for alike in settings]
    options = Options(config.highest_noll, config.held_out, config.most_names, config.sure_sigma)
    with ctx.progress(total=EXPECTED_FITS, desc="diagnose") as bar:
        return diagnose(exposures, image_effects(effects), options, device=ctx.device, report=bar.update)


def _exposures(ctx: StageContext, alike: list[Recording], effects: list[Effect]) -> Exposures:
    """Recordings of one setting, the introduced defocus in the known wavefront."""
    first = alike[0]
    return Exposures(
        _frames(alike, good_pixels(effects, first.window)),
        conditions_of(
            ctx.instrument,
            ctx.model,
            first,
            ctx.config.highest_noll,
            introduced_nm={4: introduced_nm(first)},
        ),
        screened_pixels(ctx.products["ingest"], first),
    )


def _frames(recordings: list[Recording], good: np.ndarray) -> Frames:
    """Frames of recordings of one setting, pixels that the model lists as bad masked."""
    images_e, pixel_mask, noise = pooled_images(recordings)
    if len(images_e) < FEWEST_FRAMES:
        raise InputDataError(
            f"{recordings[0].name}: a diagnosis needs {FEWEST_FRAMES} used frames, not {len(images_e)}"
        )
    return Frames(images_e, pixel_mask & torch.as_tensor(good), noise)


# -- what is reported --------------------------------------------------------------------------


def _results(result: Diagnosis) -> dict[str, Any]:
    return {
        "verdict": result.verdict,
        "sentence": sentence(result),
        "steps": [_step(step) for step in result.steps],
        "nearest": None if result.nearest is None else _step(result.nearest),
        "gap": _gap(result.gap),
        "unexplained": result.unexplained,
        "why_unknown": result.why_unknown,
        "untestable": list(result.untestable),
        "second_recording": {name: _advice(advice) for name, advice in result.advice.items()},
        "mdb": result.mdb,
        "model": MODEL_FILE,
        "noise": asdict(result.noise) | {"holds": result.noise.holds, "text": result.noise.text},
        "fine_structure": asdict(result.fine),
        "chi2_nu": dict(zip(("before", "after"), result.chi2_nu, strict=True)),
        "excess_sigma": dict(zip(("before", "after"), result.excess_sigma, strict=True)),
        "motion_ratio": result.motion_ratio,
        "drift_significance": result.drift_significance,
        "frames": dict(zip(("training", "held_out"), result.frames, strict=True)),
        "zernike_nm": dict(
            zip(("before", "after"), (_by_noll(result, m) for m in result.modes_nm), strict=True)
        ),
        "sigma_nm": _by_noll(result, result.modes_sigma_nm),
        "seconds": round(result.seconds, 3),
    }


def _step(step: Step) -> dict[str, Any]:
    return {
        "effect": step.name,
        "indistinguishable": [other.name for other in step.alternatives],
        "alternatives": [asdict(other) for other in step.alternatives],
        "parameters": step.public,
        "sigma": step.sigma,
        "significance": step.significance,
        "explained": step.explained,
        "held_out_z": step.preference,
        "gap_before": step.gap.before,
        "gap_after": step.gap.after,
        "ranking": [asdict(one) for one in step.ranking],
    }


def _advice(advice: Advice) -> dict[str, Any]:
    return {"recording": advice.recording, "survival": advice.observability, "smallest": advice.smallest}


def _gap(gap: Gap) -> dict[str, float]:
    return {"before": gap.before, "after": gap.after, "floor": gap.floor, "shrink": gap.shrink}


def _by_noll(result: Diagnosis, values: np.ndarray) -> dict[str, float]:
    return {str(n): float(v) for n, v in zip(result.nolls, values, strict=True) if n <= REPORTED}


def _arrays(result: Diagnosis) -> dict[str, Quantity]:
    pictures, before, after = result.pictures, *result.modes_nm
    return {
        "measured_e": Quantity(
            pictures.measured_e, "e-", "mean of the held-out frames", _finite(pictures.sigma_e)
        ),
        "before_e": Quantity(pictures.before_e, "e-", "predicted by the model as it was"),
        "after_e": Quantity(pictures.after_e, "e-", "predicted by the model with what was found"),
        "leading_mode": Quantity(pictures.leading, "sigma", "leading mode of the residual over the frames"),
        "added_opd_nm": Quantity(pictures.added_opd_nm, "nm", "wavefront that was added, pupil plane"),
        "added_amplitude": Quantity(pictures.added_amplitude, "", "amplitude that was added, pupil plane"),
        "noll": Quantity(np.array(result.nolls), "", "Noll index of every mode in the model"),
        "zernike_before_nm": Quantity(before, "nm", "total static wavefront, model as it was"),
        "zernike_after_nm": Quantity(after, "nm", "the same with what was found", result.modes_sigma_nm),
    }


def _finite(sigma_e: np.ndarray) -> np.ndarray:
    """Standard errors, 0 for pixels that are not used."""
    return np.where(np.isfinite(sigma_e), sigma_e, 0.0)


def _summary(result: Diagnosis) -> list[str]:
    gap = result.gap
    lines = [f"diagnosis       {result.verdict}: {sentence(result)}"]
    lines.append(
        f"  gap             {gap.before:.4f} -> {gap.after:.4f}, floor {gap.floor:.4f} (held-out frames), "
        f"χ²/ν {result.chi2_nu[0]:.2f} -> {result.chi2_nu[1]:.2f}, {result.seconds:.0f} s"
    )
    lines.append(f"  noise           {result.noise.text}")
    fine = result.fine
    lines.append(f"  finer than D/λ  {fine.ratio:.2f} × what noise leaves there, {fine.significance:.1f} σ")
    return lines


# -- the model with what was found -------------------------------------------------------------


def _model_yaml(ctx: StageContext, entries: list[dict[str, Any]]) -> bytes:
    """The recipe's section `model` with entries added to its effects."""
    section = ctx.model.model_dump(mode="json")
    section["effects"] = _with_one_list_of_pixels([*section["effects"], *entries])
    return yaml.safe_dump(section, sort_keys=False, allow_unicode=True).encode()


def _with_one_list_of_pixels(effects: list[Any]) -> list[Any]:
    """Entries of which one lists all bad pixels, wherever they were found."""
    listed = [e["bad_pixels"]["pixels"] for e in effects if isinstance(e, dict) and "bad_pixels" in e]
    if len(listed) < 2:
        return effects
    others = [e for e in effects if not (isinstance(e, dict) and "bad_pixels" in e)]
    pixels = sorted({tuple(pixel) for part in listed for pixel in part})
    return [*others, {"bad_pixels": {"pixels": [list(pixel) for pixel in pixels]}}]


def _entry(step: Step) -> dict[str, Any]:
    """A name as the section has it: values to start from, and to be fitted where a fit improves them."""
    kind, public = CATALOGUE[step.name], step.public
    values = {p.name: _plain(public[p.name]) for p in kind.public if p.name in public}
    options = {o.name: getattr(step.effect.base, o.name) for o in kind.options if o.kind == "word"}
    return {step.name: values | options | ({"fit": True} if kind.found_by == "score" else {})}


def _plain(value: Any) -> Any:
    """As YAML of a recipe has it: tables by integer."""
    return {int(key): one for key, one in value.items()} if isinstance(value, dict) else value
