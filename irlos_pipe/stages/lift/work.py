"""Stage `lift`: tip, tilt and defocus of every frame of a ramp, the NCPAs in the known wavefront."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.estimate.calibration_errors import KEPT_SIGMA, widening
from irlos_pipe.estimate.lift import (
    FrameErrors,
    excess_scatter_nm,
    instant_error_nm,
    nominal_frame_chi2,
    optics_sigma_nm,
)
from irlos_pipe.estimate.ramp import RampSummary, fit_focus_stage, summarise, summarise_one_offset
from irlos_pipe.estimate.ramp_fit import RampFit
from irlos_pipe.estimate.tabulated import FocusCurve, focus_curve
from irlos_pipe.product.product import Check, Quantity, declared
from irlos_pipe.product.results import results_of
from irlos_pipe.stages.base import StageContext, StageOutput
from irlos_pipe.stages.calibrate.stage import CalibrateResults
from irlos_pipe.stages.lift.input import (
    EXPLAINED,
    Ramp,
    fit_frames,
    has_other_light,
    older_text,
    read_ramp,
    turned_text,
)
from irlos_pipe.stages.lift.stage import ARRAYS, Config, LiftResults, Offset, Point, Twin, own_text
from irlos_pipe.stages.model.effects import model_effects
from irlos_pipe.stages.model.groups import is_ramp
from irlos_pipe.stages.model.untested import BY_RAMP

SIGMA = 5.0  # standard errors that a slope may be off, and an RMS may rise, by chance
WITHOUT_NCPAS = "without NCPAs"
TURNED = "the sign of the diversity or of the offsets, or the orientation of the images, is wrong"
CONSTANT = "a constant offset, as of a calibration of another time or instrument, or of the focus stage"
SCALED = (
    "the size of the diversity or of the offsets, the seeing or the spectrum is wrong, or a second star is "
    "in the window"
)


def run(ctx: StageContext[Config]) -> StageOutput:
    """Estimate the ramp, and repeat it with parts of the model left out to show what each contributes."""
    if 4 not in ctx.config.modes:
        raise InputDataError(
            f"lift.modes {list(ctx.config.modes)} lacks 4 (defocus), which is what LIFT is for"
        )
    ramp = read_ramp(ctx, ctx.config.input)
    fit = _fitted(ctx, ramp)
    effects = model_effects(ctx.instrument, ctx.model, ramp.recordings[0])
    with ramp.refused():  # what the focus stage really did, as far as the recipe's model says that it may err
        focus = fit_focus_stage([e for e in effects if e.plane == "ramp"], ramp.commanded_nm, fit.defocus_nm)
    ramp = replace(ramp, data=replace(ramp.data, introduced_nm=focus.introduced_nm))
    summary = _summarise(ramp, fit)
    others = _comparison(ctx, ramp, fit) if ctx.config.compare else {}
    twin, curve = _twin(ramp, fit) if ctx.config.compare else (Twin(), None)
    errors, photon_nm = _frame_errors(ramp, fit), fit.result.mode(4)[1].numpy()
    optics_nm = _optics_nm(ctx, ramp, fit)
    of_optics_nm = float(np.nanmedian(optics_nm))
    offset_nm = unexplained_offset_nm(summary, of_optics_nm) if _is_calibrated(ctx) else 0.0
    summary = replace(summary, offset_sigma_nm=math.hypot(summary.offset_sigma_nm, of_optics_nm))
    sigma_nm = errors.sigma_nm(photon_nm, np.hypot(optics_nm, offset_nm))
    turned = turned_text(ctx, ramp.acquisition)
    for text in (offset_text(summary) if offset_nm else "", older_text(fit, _wavefront_nm(ctx)), turned):
        if text:
            ctx.log.warning(text)
    converged = float(fit.result.solution.converged.double().mean())
    results = LiftResults(
        modes=list(ctx.config.modes),
        calibrated=ctx.config.calibrated,
        points=_points(ramp, fit, errors, sigma_nm, optics_nm, offset_nm),
        summary=summary,
        offsets=Offset.rows(
            introduced_nm=summary.offsets_nm, median_nm=summary.median_nm, scatter_nm=summary.scatter_nm
        ),
        effects=fit.effects | focus.effects,
        effects_sigma=fit.sigma | focus.sigma,
        effects_fitted_jointly=fit.shared is not None,
        compare=others,
        twin=twin,
        ao_defocus_nm=excess_scatter_nm(ramp.data.introduced_nm, fit.defocus_nm, photon_nm),
        chi2_nu=errors.chi2_nu,
        nominal_chi2_nu=errors.nominal_chi2_nu,
        untested=list(BY_RAMP),
    )
    return StageOutput(
        _arrays(ramp, fit, summary, sigma_nm, curve),
        results,
        checks_of(ctx.config, converged, summary, others, errors, _wavefront_nm(ctx), len(ramp.names)),
        summary=_lines(ctx, fit, summary, others),
    )


def _fitted(ctx: StageContext[Config], ramp: Ramp) -> RampFit:
    """The ramp with the calibrated wavefront, or jointly with one of its own light."""
    config = ctx.config
    own = config.own_wavefront != "never" and has_other_light(ctx, ramp.acquisition)
    if own and config.own_wavefront == "always":
        return fit_frames(ctx, ramp, own_wavefront=True)
    fit = fit_frames(ctx, ramp)
    errors = _frame_errors(ramp, fit)
    if not own or _misfit(config, errors).passed:
        return fit
    ctx.log.info(
        "median χ²/ν of the frames is %.2f: a wavefront of the ramp's own light is fitted", errors.chi2_nu
    )
    other = fit_frames(ctx, ramp, own_wavefront=True)
    return other if _frame_errors(ramp, other).excess <= EXPLAINED * errors.excess else fit


def _frame_errors(ramp: Ramp, fit: RampFit) -> FrameErrors:
    """What the frames at one offset say of noise and misfit."""
    data, result = ramp.data, fit.result
    nominal = nominal_frame_chi2(
        data.images_e,
        result.model_e,
        data.good,
        data.noise,
        data.introduced_nm,
        result.solution.values.shape[1],
    )
    instant_nm = instant_error_nm(data.introduced_nm, fit.defocus_nm, result.mode(4)[1].numpy())
    return FrameErrors(instant_nm, float(result.chi2_nu.nanmedian()), nominal)


def _is_calibrated(ctx: StageContext[Config]) -> bool:
    return ctx.config.calibrated and "calibrate" in ctx.products


def _wavefront_nm(ctx: StageContext[Config]) -> float:
    """Error of all NCPAs together [nm]; 0 where they are left out."""
    if not _is_calibrated(ctx):
        return 0.0
    sigma_nm = results_of(CalibrateResults, ctx.products["calibrate"]).wfe_sigma_nm
    return sigma_nm if np.isfinite(sigma_nm) else 0.0


def _optics_nm(ctx: StageContext[Config], ramp: Ramp, fit: RampFit) -> np.ndarray:
    """Error of every frame's defocus by that of the NCPAs [nm]; 0 where these are left out."""
    none = np.zeros(len(ramp.names))
    if not _is_calibrated(ctx):
        return none
    arrays = ctx.products["calibrate"].arrays
    nolls, covariance_nm2 = arrays["noll"].value.tolist(), arrays["covariance_nm2"].value
    if not np.isfinite(covariance_nm2).all():
        return none
    return optics_sigma_nm(fit.model, fit.result, ramp.data.good, ramp.data.noise, nolls, covariance_nm2)


def _comparison(ctx: StageContext[Config], ramp: Ramp, fit: RampFit) -> dict[str, RampSummary]:
    """Estimate the same ramp without NCPAs and without the AO residual, all else as the `fit` has it."""
    left_out: dict[str, dict[str, Any]] = {}
    if ctx.config.calibrated:
        left_out[WITHOUT_NCPAS] = {"calibrated": False}
    if ctx.config.halo != "off" and ctx.model.effects:
        left_out["without AO residual"] = {"halo": "off"}
    others = {name: ctx.config.model_copy(update=one) for name, one in left_out.items()}
    found = {name: fit_frames(replace(ctx, config=one), ramp, after=fit) for name, one in others.items()}
    return {name: _summarise(ramp, other) for name, other in found.items()}


def _twin(ramp: Ramp, fit: RampFit) -> tuple[Twin, FocusCurve | None]:
    """Whether the frame with the median χ²/ν excludes its twin; no curve without a valid fit."""
    chi2_nu = np.where(np.isfinite(fit.defocus_nm), fit.result.chi2_nu.numpy(), np.nan)
    order = np.argsort(chi2_nu)[: int(np.isfinite(chi2_nu).sum())]
    if len(order) == 0:
        return Twin(), None
    data, typical = ramp.data, int(order[len(order) // 2])
    modes_nm = fit.result.zernike_nm[typical]
    curve = focus_curve(fit.model, data.images_e[typical], data.good, data.noise, modes_nm)
    own = {"name": ramp.names[typical], "frame": ramp.frame[typical]}
    best = {"defocus_nm": curve.best_nm, "chi2_nu": curve.best_chi2_nu}
    return Twin.filled_from(curve, **own, **best), curve


def _summarise(ramp: Ramp, fit: RampFit) -> RampSummary:
    with ramp.refused():
        of_kind = summarise if is_ramp(ramp.recordings) else summarise_one_offset
        return of_kind(ramp.data.introduced_nm, fit.defocus_nm)


# -- quality control: what a ramp says against itself, and the likely reasons ------------------------


def checks_of(
    config: Config,
    converged: float,
    summary: RampSummary,
    others: Mapping[str, RampSummary],
    errors: FrameErrors,
    calibration_nm: float,
    frames: int,
) -> list[Check]:
    """Return the checks of a ramp against the limits of `config`.

    The part of the frames whose fit did is `converged`, the number of estimates `frames`. The `others` are
    the ramp with parts of the model left out; `calibration_nm` is the total error expected of the NCPAs, 0
    without.
    """
    scatter_nm, fits = summary.residual_rms_nm, f"{converged:.0%} of the frames converged"
    message = f"{scatter_nm:.1f} nm RMS about the straight line"
    checks = [
        Check("converged frames", converged, "", config.min_converged, None, fits),
        Check("scatter about the line", scatter_nm, "nm", None, config.max_residual_nm, message),
        _misfit(config, errors),
    ]
    if not math.isfinite(summary.slope):  # one focus, and no ramp
        return checks
    checks.append(_slope(config, summary))
    if config.calibrated:
        checks.append(_error(config, summary))
    if config.calibrated and WITHOUT_NCPAS in others:
        checks.append(_gain(summary, others[WITHOUT_NCPAS], calibration_nm, frames))
    return checks


def unexplained_offset_nm(summary: RampSummary, optics_nm: float = 0.0) -> float:
    """Return the size of the offset in a `summary`, or 0 where its errors excuse it [nm].

    These are that of the line, by scatter, and that by the error of the known wavefront, `optics_nm`.
    """
    offset_nm, line_nm = abs(summary.offset_nm), chance(summary.freedom) * summary.offset_sigma_nm
    return offset_nm if offset_nm > math.hypot(line_nm, KEPT_SIGMA * optics_nm) else 0.0


def chance(freedom: float) -> float:
    """Return the standard errors, from scatter with so many degrees of `freedom`, that are chance."""
    return KEPT_SIGMA * widening(freedom)


def offset_text(summary: RampSummary) -> str:
    """Return what an offset that no error of a ramp excuses says of it."""
    return (
        f"the ramp has an offset of {summary.offset_nm:+.1f} ± {summary.offset_sigma_nm:.1f} nm: a "
        "calibration of another time, or the zero point of the focus stage; it counts as an error of frames"
    )


def _slope(config: Config, summary: RampSummary) -> Check:
    """The slope, which the straight line's own error may excuse."""
    allowed = max(config.max_slope_error, max(SIGMA, chance(summary.freedom)) * summary.slope_sigma)
    why = f": {TURNED}" if summary.slope < 0 else f": {SCALED}" if abs(summary.slope - 1) > allowed else ""
    message = (
        f"estimated over introduced defocus rises by {summary.slope:.3f} ± {summary.slope_sigma:.3f}{why}"
    )
    return Check("slope", summary.slope, "", 1 - allowed, 1 + allowed, message)


def _error(config: Config, summary: RampSummary) -> Check:
    """Estimated against introduced defocus, a constant offset included."""
    message = f"estimated minus introduced defocus is {summary.rms_nm:.1f} nm RMS"
    check = Check("error", summary.rms_nm, "nm", None, config.max_error_nm, message)
    if abs(summary.offset_nm) > 0.7 * summary.rms_nm:
        return check.because(CONSTANT)
    return check.because(TURNED if summary.slope < 0 else SCALED)


def _misfit(config: Config, errors: FrameErrors) -> Check:
    """χ²/ν of the frames, over its nominal value where that is known."""
    known = math.isfinite(errors.nominal_chi2_nu)
    nominal = errors.nominal_chi2_nu if known else config.unknown_nominal_chi2_nu
    source = "their scatter lets expect" if known else "is taken as nominal, for no offset has two frames"
    message = f"median χ²/ν of the frames {errors.chi2_nu:.2f}, where {nominal:.2f} {source}"
    check = Check("chi2 of the frames", errors.chi2_nu, "", None, config.max_chi2_ratio * nominal, message)
    return check.because(
        "the model lacks something, or orientation, spectrum, scale or seeing are not as declared"
    )


def _gain(with_ncpas: RampSummary, without: RampSummary, calibration_nm: float, frames: int) -> Check:
    """A calibration has to make its ramp better, or at least not worse than its errors excuse."""
    excused = float(np.hypot(without.rms_nm, calibration_nm)) * (1 + SIGMA / np.sqrt(2 * frames))
    message = f"error {with_ncpas.rms_nm:.1f} nm RMS with NCPAs, {without.rms_nm:.1f} without"
    check = Check("gain by the NCPAs", with_ncpas.rms_nm, "nm", None, excused, message)
    return check.because("the calibration is of another instrument, time or diversity")


# -- what is reported --------------------------------------------------------------------------


def _points(
    ramp: Ramp,
    fit: RampFit,
    errors: FrameErrors,
    sigma_nm: np.ndarray,
    optics_nm: np.ndarray,
    offset_nm: float,
) -> list[Point]:
    """One row per frame, as results.json has them."""
    result, count = fit.result, len(ramp.names)
    return Point.rows(
        name=ramp.names,
        frame=ramp.frame,
        introduced_nm=ramp.data.introduced_nm,
        commanded_nm=ramp.commanded_nm,
        defocus_nm=fit.defocus_nm,
        sigma_nm=sigma_nm,
        sigma_photon_nm=result.mode(4)[1].tolist(),
        sigma_optics_nm=optics_nm,
        sigma_offset_nm=[offset_nm] * count,
        sigma_instant_nm=[errors.instant_nm] * count,
        converged=[status == "converged" for status in result.solution.status],
        status=result.solution.status,
        chi2_nu=result.chi2_nu.tolist(),
        zernike_nm=[dict(zip(result.nolls, one, strict=True)) for one in result.zernike_nm.tolist()],
    )


def _arrays(
    ramp: Ramp, fit: RampFit, summary: RampSummary, sigma_nm: np.ndarray, curve: FocusCurve | None
) -> dict[str, Quantity]:
    introduced, shape = ramp.data.introduced_nm, ramp.recordings[0].window
    model = fit.result.model_e.numpy()
    groups = [introduced == value for value in summary.offsets_nm]
    measured = np.array([ramp.data.images_e.numpy()[g].mean(0, dtype=float) for g in groups])
    modelled = np.array([model[g].mean(0) for g in groups]).reshape(-1, *shape)
    values = {
        "introduced_nm": introduced,
        "defocus_nm": (fit.defocus_nm, sigma_nm),
        "noll": fit.result.nolls,
        "zernike_nm": (fit.result.zernike_nm.numpy(), fit.result.sigma_nm.numpy()),
        "covariance_nm2": fit.result.covariance_nm2.numpy(),
        "chi2_nu": fit.result.chi2_nu.numpy(),
        "model_e": model.astype(np.float32),
        "start_nm": fit.start_nm.numpy(),
        "offsets_nm": summary.offsets_nm,
        "measured_per_offset_e": measured,
        "model_per_offset_e": modelled,
    }
    if curve is not None:
        values |= {"curve_defocus_nm": curve.focus_nm, "curve_chi2_nu": curve.chi2_nu}
    return declared(ARRAYS, values)


def _lines(
    ctx: StageContext[Config], fit: RampFit, summary: RampSummary, others: dict[str, RampSummary]
) -> list[str]:
    if not np.isfinite(summary.slope):
        return [
            f"Frames          defocus {summary.offset_nm:+.1f} nm on average beyond the known wavefront, "
            f"scatter {summary.residual_rms_nm:.1f} nm RMS"
        ]
    label = "with NCPAs" if ctx.config.calibrated else "without NCPAs"
    lines = [
        f"Ramp            slope {summary.slope:.4f} ± {summary.slope_sigma:.4f}, "
        f"offset {summary.offset_nm:+.1f} ± {summary.offset_sigma_nm:.1f} nm, "
        f"error {summary.rms_nm:.1f} nm RMS, about the line {summary.residual_rms_nm:.1f} nm ({label})"
    ]
    lines += [f"  {own}"] if (own := own_text(fit.effects)) else []
    slopes = {name: f"slope {one.slope:.4f}, error {one.rms_nm:.1f} nm RMS" for name, one in others.items()}
    return lines + [f"  {name}: {text}" for name, text in slopes.items()]
