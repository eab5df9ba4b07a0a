"""Stage `prior`: defocus of every frame of a ramp from the elongation of its image."""

from __future__ import annotations

import numpy as np
import torch

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.effects import expected, fixed_optics
from irlos_pipe.estimate.elongation import ElongationLaw, axis_ratios, calibrate_law
from irlos_pipe.frames.recording import Recording
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.product.product import Check, Quantity
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.model.effects import good_pixels, model_effects
from irlos_pipe.stages.model.recording_settings import psf_settings, used_in_time_order
from irlos_pipe.stages.prior.config import Config
from irlos_pipe.stages.prior.results import DefocusPrior, PriorResults


def run(ctx: StageContext[Config]) -> StageOutput:
    """Calibrate A and B from the model and apply them to every used frame."""
    recordings = used_in_time_order(ctx.products["ingest"], ctx.config.input)
    try:
        law = _law(ctx, recordings[0])
    except ValueError as problem:
        raise InputDataError(
            f"{recordings[0].name}: {problem}; leave the stage `prior` out for such data"
        ) from None
    listed = good_pixels(model_effects(ctx.instrument, ctx.model, recordings[0]), recordings[0].window)
    ratios = [_ratios(recording, recording.good & listed, law) for recording in recordings]
    ctx.log.info(
        "elongation law: defocus = %.1f (ratio - 1) %+.1f nm, valid %s nm", law.A, law.B, law.valid_nm
    )
    return _output(ctx, recordings, law, ratios)


def _law(ctx: StageContext[Config], recording: Recording) -> ElongationLaw:
    model = PsfModel(psf_settings(ctx.instrument, ctx.model, recording), [4], device=ctx.device)
    effects = expected(model_effects(ctx.instrument, ctx.model, recording))
    return calibrate_law(model, fixed_optics(effects, model.grids))


def _ratios(recording: Recording, good: np.ndarray, law: ElongationLaw) -> np.ndarray:
    return axis_ratios(torch.as_tensor(recording.images_e), torch.as_tensor(good), law.angle_deg)


def _output(
    ctx: StageContext[Config], recordings: list[Recording], law: ElongationLaw, ratios: list[np.ndarray]
) -> StageOutput:
    defocus = [law.defocus_nm(ratio) for ratio in ratios]
    estimates = [
        DefocusPrior(
            name=recording.name, frame=frame, introduced_nm=float(introduced), defocus_nm=float(value)
        )
        for recording, values in zip(recordings, defocus, strict=True)
        for frame, (introduced, value) in enumerate(zip(recording.introduced_defocus_nm, values, strict=True))
    ]
    failed = float(np.mean(~np.isfinite(np.concatenate(ratios))))
    arrays = {
        "ratio": Quantity(
            np.concatenate(ratios), "", "axis ratio of the fitted Gaussian, first over second axis"
        ),
        "defocus_nm": Quantity(
            np.concatenate(defocus), "nm", "prior of the defocus, frames in order of time"
        ),
        "introduced_nm": Quantity(
            np.concatenate([r.introduced_defocus_nm for r in recordings]), "nm", "introduced defocus"
        ),
    }
    results = PriorResults(
        A=law.A,
        B=law.B,
        angle_deg=law.angle_deg,
        valid_nm=law.valid_nm,
        law_residual_nm=law.residual_nm,
        estimates=estimates,
    )
    check = Check(
        "failed Gaussian fits",
        failed,
        "",
        None,
        ctx.config.max_failed_fraction,
        f"{failed:.0%} of the Gaussian fits did not converge",
    )
    summary = [
        f"Prior           defocus = {law.A:.0f} (σ1/σ2 − 1) {law.B:+.0f} nm, "
        f"valid {law.valid_nm[0]:.0f}…{law.valid_nm[1]:.0f} nm"
    ]
    return StageOutput(arrays, results, [check], summary=summary)
