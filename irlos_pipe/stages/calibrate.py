"""Stage `calibrate`: static aberrations (NCPAs) from a cube of short narrow-band exposures."""

from __future__ import annotations

from dataclasses import asdict
from typing import Literal

import numpy as np
import torch
from pydantic import Field

from irlos_pipe.effects.telling import rows_of
from irlos_pipe.errors import InputDataError
from irlos_pipe.estimate.calibration import Calibration, CalibrationOptions, calibrate
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.product import Check, Quantity
from irlos_pipe.recording import Recording
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.light_path import (
    pooled_images,
    psf_settings,
    require_one_setup,
    seeing_arcsec,
)
from irlos_pipe.stages.model_effects import effect_arrays, good_pixels, image_effects, model_effects
from irlos_pipe.stages.recordings import recordings_from_product

NAME = "calibrate"
VERSION = 1
NEEDS = ("ingest",)
READS = ("ingest",)
EXPORTED = 30  # highest Noll mode reported: SPARTA takes 29 modal offsets
MethodName = Literal["long_exposure", "dip_global", "dip_avg", "dip_joint", "lift_avg", "lift_slices"]


class Config(StageConfig):
    """Settings of the calibration."""

    input: str = Field("calibration", description="recipe input that holds the cube")
    method: MethodName = Field("long_exposure", description="what is fitted to what")
    loss: Literal["gaussian", "huber", "l1"] | None = Field(None, description="loss; none: the method's own")
    optimiser: Literal["lm", "lbfgs"] = Field(
        "lm", description="Levenberg-Marquardt, or L-BFGS with autograd"
    )
    highest_noll: int | None = Field(
        None, ge=4, le=231, description="modes 2 to this are estimated; none: the method's own"
    )
    prior_scale: float | None = Field(
        3.0, gt=0, le=1000, description="prior width over the NCPA law; none: no prior"
    )
    max_iterations: int = Field(60, ge=1, le=10000, description="per fit")
    compare: tuple[MethodName, ...] = Field((), description="methods to run beside, for the report only")
    max_chi2_nu: float = Field(5.0, gt=0, description="QC limit on the reduced chi-square of the mean image")
    min_converged: float = Field(0.9, ge=0, le=1, description="QC limit on the part of fits that converge")


def run(ctx: StageContext) -> StageOutput:
    """Calibrate with the chosen method, and with those to compare."""
    recordings = [r.accepted() for r in recordings_from_product(ctx.products["ingest"], ctx.config.input)]
    require_one_setup(recordings)
    if sum(r.frames for r in recordings) < 2:
        raise InputDataError(f"{recordings[0].name}: a calibration needs at least two used frames")
    result = _calibrate(ctx, recordings, ctx.config.method)
    others = [
        _calibrate(ctx, recordings, method, plain=True)
        for method in ctx.config.compare
        if method != ctx.config.method
    ]
    return StageOutput(
        _arrays(result),
        _results(result, others, recordings),
        _checks(ctx.config, result),
        summary=_summary(result, others),
    )


def _calibrate(
    ctx: StageContext, recordings: list[Recording], method: str, *, plain: bool = False
) -> Calibration:
    """One method on all frames; `plain` is the method as published: its own loss and modes, no prior."""
    config, first = ctx.config, recordings[0]
    options = (
        CalibrationOptions(method, prior_scale=None, max_iterations=config.max_iterations)
        if plain
        else CalibrationOptions(
            method,
            config.loss,
            config.optimiser,
            config.highest_noll,
            config.prior_scale,
            config.max_iterations,
        )
    )
    effects = model_effects(ctx.instrument, ctx.model, first, options.resolved()[1].highest_noll)
    images_e, pixel_mask, noise = pooled_images(recordings)
    frames = Frames(images_e, pixel_mask & torch.as_tensor(good_pixels(effects, first.window)), noise)
    total = len(frames.images_e) if options.resolved()[0].images == "frames" else 1
    with ctx.progress(total=total, desc=f"calibrate {method}") as bar:
        result = calibrate(
            frames,
            psf_settings(ctx.instrument, ctx.model, first),
            options,
            image_effects(effects),
            device=ctx.device,
            report=bar.update,
        )
    ctx.log.info(
        "%s: %.1f nm RMS, chi2/nu %.2f, %.1f s", method, _wfe_nm(result), result.chi2_nu, result.seconds
    )
    return result


# -- what is reported --------------------------------------------------------------------------


def _exported(result: Calibration) -> slice:
    return slice(0, _last(result) - 1)


def _last(result: Calibration) -> int:
    """Highest Noll mode reported."""
    return min(EXPORTED, result.nolls[-1])


def _wfe_nm(result: Calibration) -> float:
    """RMS of the reported modes [nm]."""
    return float(np.sqrt(np.sum(result.zernike_nm[_exported(result)] ** 2)))


def _total_sigma_nm(result: Calibration) -> float:
    """Root of the summed variances of the reported modes [nm]: the expected total error."""
    return float(np.sqrt(np.sum(result.sigma_nm[_exported(result)] ** 2)))


def _by_noll(result: Calibration, values: np.ndarray) -> dict[str, float]:
    reported = _exported(result)
    return {
        str(noll): float(value) for noll, value in zip(result.nolls[reported], values[reported], strict=True)
    }


def _counts(status: list[str]) -> dict[str, int]:
    return {name: status.count(name) for name in sorted(set(status))}


def _one(result: Calibration) -> dict:
    """The part of the results that every method has."""
    return {
        "method": result.options.method,
        "zernike_nm": _by_noll(result, result.zernike_nm),
        "sigma_nm": _by_noll(result, result.sigma_nm),
        "wfe_nm": _wfe_nm(result),
        "wfe_sigma_nm": _total_sigma_nm(result),
        "frames": len(result.frames_nm),
        "seconds": round(result.seconds, 3),
        "chi2_nu": result.chi2_nu,
        "loss": result.options.loss,
        "optimiser": result.options.optimiser,
        "modes_estimated": len(result.nolls),
        "status": _counts(result.frame_status),
    }


def _results(result: Calibration, others: list[Calibration], recordings: list[Recording]) -> dict:
    results = _one(result)
    results["effects"] = result.effects
    results["seeing_arcsec"] = seeing_arcsec(recordings[0].acquisition)
    results["twin"] = (
        None if result.twin is None else asdict(result.twin) | {"preferred": result.twin.preferred}
    )
    results["compare"] = [_one(other) for other in others]
    return results


def _arrays(result: Calibration) -> dict[str, Quantity]:
    arrays = {
        "noll": Quantity(np.array(result.nolls), "", "Noll index of every estimated mode"),
        "zernike_nm": Quantity(
            result.zernike_nm, "nm", "static wavefront without the diversity", result.sigma_nm
        ),
        "modes_nm": Quantity(result.modes_nm, "nm", "the same without what effects in the pupil add"),
        "covariance_nm2": Quantity(result.covariance_nm2, "nm2", "from the scatter over frames"),
        "frames_nm": Quantity(result.frames_nm, "nm", "coefficients of every frame (frame, mode)"),
        "frame_status": Quantity(np.array(result.frame_status, dtype=object), "", "outcome of every fit"),
        "iterations": Quantity(result.iterations, "", "of every fit"),
        "mean_image_e": Quantity(result.mean_image_e, "e-", "mean of the used frames", result.sigma_image_e),
        "model_image_e": Quantity(result.model_image_e, "e-", "its model"),
    }
    return arrays | effect_arrays(result.effect_values)


def _checks(config: Config, result: Calibration) -> list[Check]:
    converged = result.frame_status.count("converged") / len(result.frame_status)
    checks = [
        Check(
            "converged fits",
            converged,
            "",
            config.min_converged,
            None,
            f"{converged:.0%} of the fits converged",
        ),
        Check(
            "chi2 of the mean image",
            result.chi2_nu,
            "",
            None,
            config.max_chi2_nu,
            f"χ²/ν = {result.chi2_nu:.2f}; a large one says that the model lacks something",
        ),
    ]
    if result.twin is not None:
        checks.append(
            Check(
                "twin solution",
                float(result.twin.preferred == "solution"),
                "",
                1.0,
                None,
                f"sign of the even modes: the {result.twin.preferred} is preferred "
                f"(Δχ² {result.twin.delta_chi2:+.1f}, {result.twin.rms_nm:.0f} against "
                f"{result.twin.twin_rms_nm:.0f} nm RMS)",
            )
        )
    return checks


def _summary(result: Calibration, others: list[Calibration]) -> list[str]:
    lines = [
        f"NCPA            {_wfe_nm(result):.1f} ± {_total_sigma_nm(result):.1f} nm RMS "
        f"in Noll 2–{_last(result)} "
        f"({result.options.method}, {result.seconds:.1f} s, χ²/ν {result.chi2_nu:.2f})"
    ]
    for name, values in result.effects.items():
        lines.append(f"  {name:22s}" + ", ".join(f"{key} {number:.3g}" for key, number in rows_of(values)))
    lines += [
        f"  beside: {_wfe_nm(other):.1f} nm RMS ({other.options.method}, {other.seconds:.1f} s, "
        f"χ²/ν {other.chi2_nu:.2f})"
        for other in others
    ]
    return lines
