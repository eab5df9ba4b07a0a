"""What ``irlos score DIR --json`` prints."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field

from irlos_pipe.product.printed import Printed
from irlos_pipe.product.results import Number, ResultsPart


class MethodScore(ResultsPart):
    """Errors of a calibration against the truth.

    Attributes
    ----------
    error_nm : float
        RMS error of the reported modes against the mean wavefront.
    defocus_error_nm : float
        Error of its defocus, with sign.
    seconds : float
        Time of the fit.
    static_error_nm, pull_rms : float
        RMS error against the static modes without tip and tilt, and the RMS of these errors in units of the
        quoted ones; null where the truth does not state static modes.
    """

    method: str = ""
    error_nm: Number = math.nan
    defocus_error_nm: Number = math.nan
    seconds: Number = math.nan
    static_error_nm: Number = math.nan
    pull_rms: Number = math.nan


class CalibrationScore(ResultsPart):
    """How far a calibration is from the truth, by method."""

    recordings: list[str] = []
    static_known: bool = False
    methods: list[MethodScore] = []


class RampScore(ResultsPart):
    """RMS errors of the defocus of a ramp.

    Attributes
    ----------
    recordings, frames : int
        How many are compared.
    against_introduced_nm, against_true_nm : float
        Frames against the introduced defocus, and against the true mean defocus.
    means_against_true_nm : float
        Means of recordings against the true mean defocus.
    """

    recordings: int = 0
    frames: int = 0
    against_introduced_nm: Number = math.nan
    against_true_nm: Number = math.nan
    means_against_true_nm: Number = math.nan


class Score(Printed):
    """What ``irlos score DIR --json`` prints; None for what was not run or has no truth."""

    format: Literal["irlos-score"] = Field("irlos-score", alias="schema")
    run: str = ""
    calibration: CalibrationScore | None = None
    ramp: RampScore | None = None
