"""What ``irlos score DIR --json`` prints."""

from __future__ import annotations

from math import nan
from typing import Literal

from pydantic import Field

from irlos_pipe.product.printed import Printed
from irlos_pipe.product.results import DITTO, Number, ResultsPart, item


class MethodScore(ResultsPart):
    """Errors of a calibration against the truth."""

    method: str = ""
    error_nm: Number = item(nan, "RMS error of the reported modes against the mean wavefront.")
    defocus_error_nm: Number = item(nan, "Error of its defocus, with sign.")
    seconds: Number = item(nan, "Time of the fit.")
    static_error_nm: Number = item(
        nan,
        "RMS error against the static modes without tip and tilt, and the RMS of these errors in units of "
        "the quoted ones; null where the truth does not state static modes.",
    )
    pull_rms: Number = item(nan, DITTO)


class CalibrationScore(ResultsPart):
    """How far a calibration is from the truth, by method."""

    recordings: list[str] = []
    static_known: bool = False
    methods: list[MethodScore] = []


class RampScore(ResultsPart):
    """RMS errors of the defocus of a ramp."""

    recordings: int = item(0, "How many are compared.")
    frames: int = item(0, DITTO)
    against_introduced_nm: Number = item(
        nan, "Frames against the introduced defocus, and against the true mean defocus."
    )
    against_true_nm: Number = item(nan, DITTO)
    means_against_true_nm: Number = item(nan, "Means of recordings against the true mean defocus.")


class Score(Printed):
    """What ``irlos score DIR --json`` prints; None for what was not run or has no truth."""

    format: Literal["irlos-score"] = Field("irlos-score", alias="schema")
    run: str = ""
    calibration: CalibrationScore | None = None
    ramp: RampScore | None = None
