"""Stage `lift`: tip, tilt and defocus of every frame of a ramp, the NCPAs in the known wavefront."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import BeforeValidator, Field

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.laws import NcpaLaw
from irlos_pipe.estimate.lift import LiftOptions, NoiseSource
from irlos_pipe.estimate.ncpa_prior import NcpaPrior
from irlos_pipe.estimate.ramp import FocusStage, RampSummary, fit_focus_stage, summarise
from irlos_pipe.estimate.ramp_fit import RampFit, fit_ramp
from irlos_pipe.product.product import Check, Quantity
from irlos_pipe.stages.base import StageConfig, StageContext, StageOutput
from irlos_pipe.stages.lift.input import (
    Ramp,
    calibrated_ncpa_nm,
    effects_for_lift,
    ramp_model,
    ramp_start,
    read_ramp,
)
from irlos_pipe.stages.lift.results import LiftResults, Line, Offset, Point
from irlos_pipe.stages.model.effects import model_effects

NAME = "lift"
VERSION = 7
NEEDS = ("ingest",)
READS = ("ingest", "prior", "calibrate")
# "told" is the former spelling of "commanded".
Start = Annotated[
    Literal["elongation", "scan", "commanded", "zero"],
    BeforeValidator(lambda value: "commanded" if value == "told" else value),
]
ObjectSigma = Literal["calibrated", "fit"] | Annotated[float, Field(ge=0, le=200)]


class Config(StageConfig):
    """Settings of LIFT."""

    input: str = Field("ramp", description="recipe input that holds the ramp")
    modes: tuple[int, ...] = Field((2, 3, 4), description="Noll modes to estimate; 4 (defocus) among them")
    calibrated: bool = Field(True, description="make the NCPAs of `calibrate` a part of the known wavefront")
    halo: Literal["calibrated", "fit", "off"] = Field(
        "calibrated", description="AO residual in the model: as calibrated, fitted to the ramp, or none"
    )
    object_sigma_mas: ObjectSigma = Field(
        "calibrated",
        description="width of the kernel of object and jitter: a number [mas], as calibrated, or "
        "fitted to the ramp",
    )
    estimator: Literal["ml", "map"] = Field("ml", description="maximum likelihood, or with a Gaussian prior")
    prior_scale: float = Field(
        3.0, gt=0, le=1000, description="width of the prior of MAP over that of the NCPA law"
    )
    noise: NoiseSource = Field(
        LiftOptions.noise,
        description="variances of the pixels: from the data, from the start's model, or renewed with the fit",
    )
    start: Start = Field(
        "elongation",
        description="where the iteration begins: at the elongation prior, at the best of a scan of defocus, "
        "at the commanded defocus (needed without diversity, where the sign of defocus is ambiguous), or at "
        "zero",
    )
    max_iterations: int = Field(
        LiftOptions.max_iterations, ge=1, le=1000, description="largest number of iterations of a fit"
    )
    compare: bool = Field(
        True, description="repeat without the NCPAs and without the AO residual, for the report"
    )
    min_converged: float = Field(0.9, ge=0, le=1, description="QC limit on the part of frames that converge")
    max_residual_nm: float = Field(
        30.0, gt=0, description="QC limit on the scatter about the straight line [nm RMS]"
    )


def run(ctx: StageContext[Config]) -> StageOutput:
    """Estimate the ramp, and repeat it with parts of the model left out to show what each contributes."""
    if 4 not in ctx.config.modes:
        raise InputDataError(
            f"lift.modes {list(ctx.config.modes)} lacks 4 (defocus), which is what LIFT is for"
        )
    ramp = read_ramp(ctx, ctx.config.input)
    fit = _fit(ctx, ramp, calibrated=ctx.config.calibrated, halo=ctx.config.halo)
    focus = _focus_stage(ctx, ramp, fit)
    ramp = replace(ramp, data=replace(ramp.data, introduced_nm=focus.introduced_nm))
    summary = _summarise(ramp, fit)
    others = _comparison(ctx, ramp) if ctx.config.compare else {}
    return StageOutput(
        _arrays(ramp, fit, summary),
        _results(ctx, ramp, fit, summary, others, focus),
        _checks(ctx.config, fit, summary),
        summary=_lines(ctx, fit, summary, others),
    )


def _fit(ctx: StageContext[Config], ramp: Ramp, *, calibrated: bool, halo: str) -> RampFit:
    ncpa_nm = calibrated_ncpa_nm(ctx) if calibrated else {}
    model = ramp_model(ctx, ramp, ctx.config.modes, ncpa_nm)
    recording, kernel = ramp.recordings[0], ctx.config.object_sigma_mas
    effects = effects_for_lift(ctx, recording, halo, kernel, calibrated=calibrated)
    start = ramp_start(ctx, model, ramp, ncpa_nm, ctx.config.start)
    with ctx.progress(total=len(ramp.names), desc="lift") as bar:
        return fit_ramp(
            model,
            ramp.data,
            start,
            _options(ctx.config, ctx.instrument.facility.ncpa_law, start),
            effects,
            report=bar.update,
        )


def _focus_stage(ctx: StageContext[Config], ramp: Ramp, fit: RampFit) -> FocusStage:
    """What the focus stage really did, as far as the recipe's model says that it may err."""
    effects = model_effects(ctx.instrument, ctx.model, ramp.recordings[0])
    ramp_effects = [effect for effect in effects if effect.plane == "ramp"]
    try:
        return fit_focus_stage(ramp_effects, ramp.commanded_nm, fit.defocus_nm)
    except ValueError as problem:
        raise InputDataError(f"ramp of {len(ramp.recordings)} recordings: {problem}") from None


def _options(config: Config, ncpa_law: NcpaLaw, start_nm: torch.Tensor) -> LiftOptions:
    """ML, or MAP about the start's defocus and zero for the other modes."""
    if config.estimator == "ml":
        return LiftOptions(config.noise, max_iterations=config.max_iterations)
    mean = torch.zeros_like(start_nm)
    focus = config.modes.index(4)
    mean[:, focus] = start_nm[:, focus]
    sigma_nm = NcpaPrior(ncpa_law, config.prior_scale).sigma_nm(config.modes)
    return LiftOptions(config.noise, mean, sigma_nm, config.max_iterations)


def _comparison(ctx: StageContext[Config], ramp: Ramp) -> dict[str, RampSummary]:
    """Estimate the same ramp without NCPAs and without the AO residual."""
    config, found = ctx.config, {}
    if config.calibrated:
        found["without NCPAs"] = _fit(ctx, ramp, calibrated=False, halo=config.halo)
    if config.halo != "off" and ctx.model.effects:
        found["without AO residual"] = _fit(ctx, ramp, calibrated=config.calibrated, halo="off")
    return {name: _summarise(ramp, fit) for name, fit in found.items()}


def _summarise(ramp: Ramp, fit: RampFit) -> RampSummary:
    try:
        return summarise(ramp.data.introduced_nm, fit.defocus_nm)
    except ValueError as problem:
        raise InputDataError(f"ramp of {len(ramp.recordings)} recordings: {problem}") from None


# -- what is reported --------------------------------------------------------------------------


def _results(
    ctx: StageContext[Config],
    ramp: Ramp,
    fit: RampFit,
    summary: RampSummary,
    others: dict[str, RampSummary],
    focus: FocusStage,
) -> LiftResults:
    return LiftResults(
        modes=list(ctx.config.modes),
        calibrated=ctx.config.calibrated,
        points=_points(ramp, fit),
        summary=_line(summary),
        offsets=_offsets(summary),
        effects=fit.effects | focus.effects,
        effects_sigma=focus.sigma,
        effects_fitted_jointly=fit.shared is not None,
        compare={name: _line(other) for name, other in others.items()},
    )


def _points(ramp: Ramp, fit: RampFit) -> list[Point]:
    """One row per frame, as results.json has them."""
    defocus, sigma = fit.defocus_nm.tolist(), fit.result.mode(4)[1].tolist()
    return [
        Point(
            name=name,
            frame=ramp.frame[i],
            introduced_nm=float(ramp.data.introduced_nm[i]),
            commanded_nm=float(ramp.commanded_nm[i]),
            defocus_nm=defocus[i],
            sigma_nm=sigma[i],
            converged=fit.result.solution.status[i] == "converged",
            status=fit.result.solution.status[i],
            chi2_nu=float(fit.result.chi2_nu[i]),
            zernike_nm=dict(zip(fit.result.nolls, fit.result.zernike_nm[i].tolist(), strict=True)),
        )
        for i, name in enumerate(ramp.names)
    ]


def _line(summary: RampSummary) -> Line:
    return Line(**{key: getattr(summary, key) for key in Line.model_fields})


def _offsets(summary: RampSummary) -> list[Offset]:
    return [
        Offset(introduced_nm=float(o), median_nm=float(m), scatter_nm=float(s))
        for o, m, s in zip(summary.offsets_nm, summary.median_nm, summary.scatter_nm, strict=True)
    ]


def _arrays(ramp: Ramp, fit: RampFit, summary: RampSummary) -> dict[str, Quantity]:
    introduced, shape = ramp.data.introduced_nm, ramp.recordings[0].window
    model = fit.result.model_e.numpy()
    groups = [introduced == value for value in summary.offsets_nm]
    measured = np.array([ramp.data.images_e.numpy()[g].mean(0, dtype=float) for g in groups])
    modelled = np.array([model[g].mean(0) for g in groups]).reshape(-1, *shape)
    defocus, sigma = fit.defocus_nm, fit.result.mode(4)[1].numpy()
    return {
        "introduced_nm": Quantity(introduced, "nm", "introduced defocus, frames in order of time"),
        "defocus_nm": Quantity(defocus, "nm", "estimated introduced defocus", sigma),
        "noll": Quantity(np.array(fit.result.nolls), "", "estimated modes"),
        "zernike_nm": Quantity(
            fit.result.zernike_nm.numpy(), "nm", "estimates (frame, mode)", fit.result.sigma_nm.numpy()
        ),
        "covariance_nm2": Quantity(fit.result.covariance_nm2.numpy(), "nm2", "per frame"),
        "chi2_nu": Quantity(fit.result.chi2_nu.numpy(), "", "per frame"),
        "model_e": Quantity(model.astype(np.float32), "e-", "model of every frame"),
        "start_nm": Quantity(fit.start_nm.numpy(), "nm", "start of every frame"),
        "offsets_nm": Quantity(summary.offsets_nm, "nm", "the offsets of the ramp"),
        "measured_per_offset_e": Quantity(measured, "e-", "mean frame of every offset"),
        "model_per_offset_e": Quantity(modelled, "e-", "mean model of every offset"),
    }


def _checks(config: Config, fit: RampFit, summary: RampSummary) -> list[Check]:
    converged = float(fit.result.solution.converged.double().mean())
    return [
        Check(
            "converged frames",
            converged,
            "",
            config.min_converged,
            None,
            f"{converged:.0%} of the frames converged",
        ),
        Check(
            "scatter about the line",
            summary.residual_rms_nm,
            "nm",
            None,
            config.max_residual_nm,
            f"{summary.residual_rms_nm:.1f} nm RMS about the straight line",
        ),
    ]


def _lines(
    ctx: StageContext[Config], fit: RampFit, summary: RampSummary, others: dict[str, RampSummary]
) -> list[str]:
    label = "with NCPAs" if ctx.config.calibrated else "without NCPAs"
    lines = [
        f"Ramp            slope {summary.slope:.4f} ± {summary.slope_sigma:.4f}, "
        f"offset {summary.offset_nm:+.1f} nm, "
        f"error {summary.rms_nm:.1f} nm RMS, about the line {summary.residual_rms_nm:.1f} nm ({label})"
    ]
    lines += [
        f"  {name}: slope {other.slope:.4f}, error {other.rms_nm:.1f} nm RMS"
        for name, other in others.items()
    ]
    return lines
