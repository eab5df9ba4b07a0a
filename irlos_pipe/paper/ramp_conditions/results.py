"""Results of the experiment `ramp_conditions`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.paper.common.results import Interval
from irlos_pipe.product.results import Number, ResultsPart, StageResults


class ModeRow(ResultsPart):
    """One mode of the frames of a ramp, RMS over the ramps.

    Attributes
    ----------
    noll : int
    error_nm : Interval
        RMS error against the mode there was in the frame.
    sigma_nm : float
        Median quoted error of photon noise.
    scatter_nm, true_scatter_nm : float
        Over the frames of a ramp, beside what goes with the introduced defocus: estimated, and there.
    leak : float
        Part of the introduced defocus that goes into it; of defocus itself, slope minus 1.
    """

    noll: int = 0
    error_nm: Interval = Interval()
    sigma_nm: Number = math.nan
    scatter_nm: Number = math.nan
    true_scatter_nm: Number = math.nan
    leak: Number = math.nan


class WayRow(ResultsPart):
    """One way to estimate the ramps of one condition, RMS over the ramps.

    Attributes
    ----------
    condition, condition_label, way, label : str
        Keys of `CONDITIONS` and `WAYS`, and what they are.
    rms_nm : Interval
        Of the estimated minus the introduced defocus; the AO residual's own defocus counts as an error.
    true_rms_nm : Interval
        Of the estimated minus the defocus there was in each frame.
    bias_nm : Interval
        Mean of that over a ramp.
    converged : float
        Smallest part of the frames of a ramp.
    asked_nm : float
        Limit of `true_rms_nm`; NaN where there is none.
    """

    condition: str = ""
    condition_label: str = ""
    way: str = ""
    label: str = ""
    rms_nm: Interval = Interval()
    true_rms_nm: Interval = Interval()
    bias_nm: Interval = Interval()
    converged: Number = math.nan
    asked_nm: Number = math.nan
    modes: list[ModeRow] = []


class RampConditionsResults(StageResults):
    """Calibrated ramps whose light has what their calibration could not show."""

    stage: ClassVar[str] = "ramp_conditions"
    samples: int = 0
    rows: list[WayRow] = []
