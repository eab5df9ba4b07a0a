"""Stage `prior`: defocus of every frame of a ramp from the elongation of its image."""

import math
from math import nan
from typing import ClassVar

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.late import torch
from irlos_pipe.product.product import Check, declared
from irlos_pipe.product.results import DITTO, Number, ResultsPart, StageResults, item
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput, refused

VERSION = 2
NEEDS = ("ingest",)
ARRAYS = {
    "defocus_nm": ("nm", "frame", "prior of the defocus, frames in order of time"),
    "introduced_nm": ("nm", "frame", "introduced defocus"),
    "ratio": ("", "frame", "axis ratio of the fitted Gaussian, first over second axis"),
}
CHECKS = {
    "failed Gaussian fits": (
        "part of the frames whose elongation could not be measured",
        "max_failed_fraction",
    )
}


class Config(StageConfig):
    """Settings of the elongation prior."""

    input: str = item("ramp", "recipe input whose frames get a prior")
    max_failed_fraction: float = item(0.1, "QC limit on Gaussian fits that fail", ge=0, le=1)


class DefocusPrior(ResultsPart):
    """Prior of the defocus of one frame."""

    name: str = item("", "Recording, in which the frame has the number `frame`.")
    frame: int = item(0, "Number of the frame in its recording, from 0.")
    introduced_nm: Number = item(nan, "Defocus introduced by the focus stage.")
    defocus_nm: Number = item(nan, "Defocus by the law, from the widths of the image.")


class PriorResults(StageResults):
    """The law defocus = `A` (σ1/σ2 − 1) + `B` [nm], and what it gives for every frame."""

    stage: ClassVar[str] = "prior"
    A: Number = item(
        nan, "Slope and constant of the law [nm]; σ1 and σ2 are the widths of the image along the two axes."
    )
    B: Number = item(nan, DITTO)
    angle_deg: Number = item(nan, "Direction of the first axis, from +x towards +y.")
    valid_nm: tuple[Number, Number] = item((math.nan, math.nan), "Range of defocus of the law.")
    law_residual_nm: Number = item(nan, "RMS departure of the law from the model.")
    estimates: list[DefocusPrior] = []


Results = PriorResults


def run(ctx: StageContext[Config]) -> StageOutput:
    """Calibrate A and B from the model and apply them to every used frame."""
    from irlos_pipe.effects import expected, fixed_optics
    from irlos_pipe.estimate.elongation import axis_ratios, calibrate_law
    from irlos_pipe.optics.psf import PsfModel
    from irlos_pipe.stages.model.effects import good_pixels, model_effects, psf_settings, used_in_time_order

    recordings = used_in_time_order(ctx.products["ingest"], ctx.config.input)
    first = recordings[0]
    with refused(InputDataError, first.name, "; leave the stage `prior` out for such data"):
        model = PsfModel(psf_settings(ctx.instrument, ctx.model, first), [4], device=ctx.device)
        effects = model_effects(ctx.instrument, ctx.model, first)
        law = calibrate_law(model, fixed_optics(expected(effects), model.grids))
    listed = good_pixels(effects, first.window)
    ratios = [
        axis_ratios(torch.as_tensor(one.images_e), torch.as_tensor(one.good & listed), law.angle_deg)
        for one in recordings
    ]
    ctx.log.info(
        "elongation law: defocus = %.1f (ratio - 1) %+.1f nm, valid %s nm", law.A, law.B, law.valid_nm
    )
    ratio, defocus_nm = np.concatenate(ratios), np.concatenate([law.defocus_nm(one) for one in ratios])
    introduced_nm = np.concatenate([one.introduced_defocus_nm for one in recordings])
    estimates = DefocusPrior.rows(
        name=[one.name for one in recordings for _ in range(one.frames)],
        frame=[frame for one in recordings for frame in range(one.frames)],
        introduced_nm=introduced_nm,
        defocus_nm=defocus_nm,
    )
    results = PriorResults.filled_from(law, law_residual_nm=law.residual_nm, estimates=estimates)
    failed = float(np.mean(~np.isfinite(ratio)))
    message = f"{failed:.0%} of the Gaussian fits did not converge"
    low, high = law.valid_nm
    return StageOutput(
        declared(ARRAYS, {"ratio": ratio, "defocus_nm": defocus_nm, "introduced_nm": introduced_nm}),
        results,
        [Check("failed Gaussian fits", failed, "", None, ctx.config.max_failed_fraction, message)],
        summary=[
            f"Prior           defocus = {law.A:.0f} (σ1/σ2 − 1) {law.B:+.0f} nm, "
            f"valid {low:.0f}…{high:.0f} nm"
        ],
    )
