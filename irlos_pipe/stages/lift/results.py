"""Results of stage `lift`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.product.results import ByNoll, EffectValues, Number, ResultsPart, StageResults

ARRAYS = {
    "noll": ("", "mode", "estimated modes"),
    "zernike_nm": ("nm ±", "frame, mode", "estimates, errors of photon noise"),
    "covariance_nm2": ("nm2", "frame, mode, mode", "covariance of the estimates"),
    "defocus_nm": ("nm ±", "frame", "estimated introduced defocus"),
    "introduced_nm": ("nm", "frame", "introduced defocus, frames in order of time"),
    "start_nm": ("nm", "frame, mode", "start of every frame"),
    "chi2_nu": ("", "frame", "χ²/ν of every frame"),
    "model_e": ("e-", "frame, y, x", "model of every frame"),
    "offsets_nm": ("nm", "offset", "the offsets of the ramp"),
    "measured_per_offset_e": ("e-", "offset, y, x", "mean frame of every offset"),
    "model_per_offset_e": ("e-", "offset, y, x", "mean model of every offset"),
    "curve_defocus_nm": ("nm", "value", "defocus at which one frame was held"),
    "curve_chi2_nu": ("", "value", "χ²/ν of the best fit of that frame with this defocus"),
}
CHECKS = {
    "converged frames": ("part of the frames whose fit converged", "min_converged"),
    "scatter about the line": ("RMS of the estimates about a straight line", "max_residual_nm"),
    "slope": ("slope of the estimated against the introduced defocus", "max_slope_error"),
    "chi2 of the frames": (
        "median reduced χ² of the frames against what their scatter lets expect",
        "max_chi2_ratio",
    ),
    "error": ("RMS of estimated minus introduced defocus", "max_error_nm"),
    "gain by the NCPAs": (
        "error with the NCPAs, which may not be worse than without them by more than their errors excuse",
        "",
    ),
}
DECISIVE = 10.0  # evidence from which the twin counts as excluded: odds of 150 to 1


class Point(ResultsPart):
    """Estimate of one frame.

    Attributes
    ----------
    name : str
        Recording, in which the frame has the number `frame`.
    frame : int
        Number of the frame in its recording, from 0.
    introduced_nm, commanded_nm : float
        Introduced defocus as the model has it, and as commanded.
    defocus_nm, sigma_nm : float
        Estimate with its standard error; NaN where the fit is invalid.
    sigma_photon_nm, sigma_instant_nm, sigma_optics_nm : float
        The parts of `sigma_nm`: by photon and read-out noise, which grows by the misfit of the model; of the
        instant, by which errors differ from frame to frame, above all by the AO residual's own defocus in
        the exposure; of the optics, by the covariance of the NCPAs, which all frames share.
    sigma_offset_nm : float
        A fourth part, which all frames share as well: the offset of the ramp, where its error does not
        excuse it; else 0.
    converged : bool
        Whether the fit ended at a minimum.
    status : str
        How the fit of the frame ended.
    chi2_nu : float
        Reduced χ² of the frame.
    zernike_nm : dict of int to float
        All estimated modes.
    """

    name: str = ""
    frame: int = 0
    introduced_nm: Number = math.nan
    commanded_nm: Number = math.nan
    defocus_nm: Number = math.nan
    sigma_nm: Number = math.nan
    sigma_photon_nm: Number = math.nan
    sigma_instant_nm: Number = math.nan
    sigma_optics_nm: Number = math.nan
    sigma_offset_nm: Number = 0.0
    converged: bool = True
    status: str = ""
    chi2_nu: Number = math.nan
    zernike_nm: ByNoll = {}


class Line(ResultsPart):
    """The straight line of a ramp, see `estimate.ramp.RampSummary`.

    Attributes
    ----------
    slope, slope_sigma : float
        Estimated over introduced defocus, 1 is right, and its standard error.
    offset_nm : float
        Estimated defocus where none is introduced, by the line.
    offset_sigma_nm : float
        Its standard error, by the scatter about the line and, with NCPAs, by theirs.
    rms_nm : float
        RMS of estimated minus introduced defocus.
    residual_rms_nm : float
        RMS of the estimates about the line.
    saw_tooth_nm, saw_tooth_sigma_nm : float
        Difference between offsets reached upwards and downwards, by hysteresis of the focus stage, and its
        standard error; NaN where only one direction occurs.
    """

    slope: Number = math.nan
    slope_sigma: Number = math.nan
    offset_nm: Number = math.nan
    offset_sigma_nm: Number = math.nan
    rms_nm: Number = math.nan
    residual_rms_nm: Number = math.nan
    saw_tooth_nm: Number = math.nan
    saw_tooth_sigma_nm: Number = math.nan


class Offset(ResultsPart):
    """Median and 1σ scatter of the estimates at one introduced defocus.

    Attributes
    ----------
    introduced_nm : float
        Introduced defocus.
    median_nm : float
        Median of the estimates there.
    scatter_nm : float
        Their 1σ scatter, from the 16th and 84th percentile.
    """

    introduced_nm: Number = math.nan
    median_nm: Number = math.nan
    scatter_nm: Number = math.nan


class Twin(ResultsPart):
    """Whether the other sign of defocus is excluded, by a frame of median χ²/ν; see `estimate.tabulated`.

    Attributes
    ----------
    name : str
        Recording, in which the frame has the number `frame`.
    frame : int
        Number of the frame in its recording, from 0.
    defocus_nm, chi2_nu : float
        Best fit of the frame.
    twin_nm, twin_chi2_nu : float
        Defocus and χ²/ν of the best of the other minima; NaN where there is none.
    delta_chi2, evidence : float
        χ² of that minus χ² of the best fit; the same divided by the χ²/ν of the best fit where that is more
        than 1. From 10 on the twin is excluded.
    """

    name: str = ""
    frame: int = 0
    defocus_nm: Number = math.nan
    chi2_nu: Number = math.nan
    twin_nm: Number = math.nan
    twin_chi2_nu: Number = math.nan
    delta_chi2: Number = math.nan
    evidence: Number = math.nan


class LiftResults(StageResults):
    """A ramp.

    Attributes
    ----------
    modes : list of int
        Estimated modes (Noll).
    calibrated : bool
        Whether the NCPAs are part of the known wavefront.
    effects, effects_sigma : dict of str to dict
        Effects that the fit used or found, and standard errors of those of the focus stage.
    effects_fitted_jointly : bool
        Whether effects were fitted to all frames together.
    compare : dict of str to Line
        The same ramp with parts of the model left out.
    twin : Twin
        Whether the other sign of defocus is excluded, by one frame; without name where it was not looked for.
    ao_defocus_nm : float
        Scatter of the estimates at one offset beyond photon noise.
    chi2_nu, nominal_chi2_nu : float
        Median of the frames, and what their scatter lets expect of a right model.
    """

    stage: ClassVar[str] = "lift"
    modes: list[int] = []
    calibrated: bool = False
    points: list[Point] = []
    summary: Line = Line()
    offsets: list[Offset] = []
    effects: dict[str, EffectValues] = {}
    effects_sigma: dict[str, EffectValues] = {}
    effects_fitted_jointly: bool = False
    compare: dict[str, Line] = {}
    twin: Twin = Twin()
    ao_defocus_nm: Number = math.nan
    chi2_nu: Number = math.nan
    nominal_chi2_nu: Number = math.nan
