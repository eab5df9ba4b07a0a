"""Quality control of stage `lift`: what a ramp says against itself, and the likely reasons."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from irlos_pipe.estimate.lift_errors import FrameErrors
from irlos_pipe.estimate.ramp import RampSummary
from irlos_pipe.product.product import Check
from irlos_pipe.stages.lift.stage import Config

OFFSET_SIGMA = 3.0  # standard errors from which an offset is none of chance
SIGMA = 5.0  # standard errors that a slope may be off, and an RMS may rise, by chance
WITHOUT_NCPAS = "without NCPAs"
TURNED = "the sign of the diversity or of the offsets, or the orientation of the images, is wrong"
SCALED = (
    "the size of the diversity or of the offsets, the seeing or the spectrum is wrong, or a second star is "
    "in the window"
)


def checks_of(
    config: Config,
    converged: float,
    summary: RampSummary,
    others: Mapping[str, RampSummary],
    errors: FrameErrors,
    calibration_nm: float,
    frames: int,
) -> list[Check]:
    """Return the checks of a ramp.

    Parameters
    ----------
    config : Config
        Its limits.
    converged : float
        Part of the frames whose fit converged.
    summary : RampSummary
    others : mapping of str to RampSummary
        The ramp with parts of the model left out.
    errors : FrameErrors
    calibration_nm : float
        Total error expected of the NCPAs [nm RMS]; 0 without.
    frames : int
        Number of estimates.
    """
    checks = [
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


def unexplained_offset_nm(summary: RampSummary) -> float:
    """Return the size of the offset in a `summary`, or 0 where its own error excuses it [nm]."""
    offset_nm = abs(summary.offset_nm)
    return offset_nm if offset_nm > OFFSET_SIGMA * summary.offset_sigma_nm else 0.0


def offset_text(summary: RampSummary) -> str:
    """Return what an offset that no error of a ramp excuses says of it."""
    return (
        f"the ramp has an offset of {summary.offset_nm:+.1f} ± {summary.offset_sigma_nm:.1f} nm: a "
        "calibration of another time, or the zero point of the focus stage; it counts as an error of frames"
    )


def _slope(config: Config, summary: RampSummary) -> Check:
    """The slope, which the straight line's own error may excuse."""
    allowed = max(config.max_slope_error, SIGMA * summary.slope_sigma)
    why = f": {TURNED}" if summary.slope < 0 else f": {SCALED}" if abs(summary.slope - 1) > allowed else ""
    message = (
        f"estimated over introduced defocus rises by {summary.slope:.3f} ± {summary.slope_sigma:.3f}{why}"
    )
    return Check("slope", summary.slope, "", 1 - allowed, 1 + allowed, message)


def _error(config: Config, summary: RampSummary) -> Check:
    """Estimated against introduced defocus, a constant offset included."""
    why = ""
    if summary.rms_nm > config.max_error_nm:
        constant = abs(summary.offset_nm) > 0.7 * summary.rms_nm
        why = (
            ": a constant offset, as of a calibration of another time or instrument, or of the focus stage"
            if constant
            else f": {TURNED if summary.slope < 0 else SCALED}"
        )
    message = f"estimated minus introduced defocus is {summary.rms_nm:.1f} nm RMS{why}"
    return Check("error", summary.rms_nm, "nm", None, config.max_error_nm, message)


def misfits(config: Config, errors: FrameErrors) -> bool:
    """Return whether χ²/ν of the frames, in `errors`, is above its limit in `config`."""
    return not _misfit(config, errors).passed


def _misfit(config: Config, errors: FrameErrors) -> Check:
    """χ²/ν of the frames, over its nominal value where that is known."""
    known = math.isfinite(errors.nominal_chi2_nu)
    nominal = errors.nominal_chi2_nu if known else config.unknown_nominal_chi2_nu
    limit = config.max_chi2_ratio * nominal
    why = (
        ": the model lacks something, or orientation, spectrum, scale or seeing are not as told"
        if errors.chi2_nu > limit
        else ""
    )
    source = "their scatter lets expect" if known else "is taken as nominal, for no offset has two frames"
    message = f"median χ²/ν of the frames {errors.chi2_nu:.2f}, where {nominal:.2f} {source}{why}"
    return Check("chi2 of the frames", errors.chi2_nu, "", None, limit, message)


def _gain(with_ncpas: RampSummary, without: RampSummary, calibration_nm: float, frames: int) -> Check:
    """A calibration has to make its ramp better, or at least not worse than its errors excuse."""
    excused = float(np.hypot(without.rms_nm, calibration_nm)) * (1 + SIGMA / np.sqrt(2 * frames))
    worse = with_ncpas.rms_nm > excused
    why = ": the calibration is of another instrument, time or diversity" if worse else ""
    message = f"error {with_ncpas.rms_nm:.1f} nm RMS with NCPAs, {without.rms_nm:.1f} without{why}"
    return Check("gain by the NCPAs", with_ncpas.rms_nm, "nm", None, excused, message)
