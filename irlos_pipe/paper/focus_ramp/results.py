"""Results of the experiment `focus_ramp`."""

from __future__ import annotations

from typing import ClassVar

from irlos_pipe.paper.common.results import Percentiles
from irlos_pipe.product.results import ResultsPart, StageResults


class VariantRow(ResultsPart):
    """One variant of LIFT, medians and spreads over the ramps.

    Attributes
    ----------
    key : str
        Of `LIFT_VARIANTS`.
    modes : list of int
        Noll.
    ncpa : str or None
        Calibration method whose NCPAs were known.
    slope, offset_nm : Percentiles
        Of the estimated against the introduced defocus.
    rms_nm, line_rms_nm : Percentiles
        RMS of estimated minus introduced defocus, and about the straight line.
    true_rms_nm : Percentiles
        RMS against introduced defocus, NCPAs and AO residual of each frame.
    converged : Percentiles
        Part of the frames.
    """

    key: str = ""
    label: str = ""
    modes: list[int] = []
    ncpa: str | None = None
    slope: Percentiles = Percentiles()
    offset_nm: Percentiles = Percentiles()
    rms_nm: Percentiles = Percentiles()
    line_rms_nm: Percentiles = Percentiles()
    true_rms_nm: Percentiles = Percentiles()
    converged: Percentiles = Percentiles()


class FocusRampResults(StageResults):
    """Focus ramps estimated with and without calibrated NCPAs; `ways` are the variants of LIFT."""

    stage: ClassVar[str] = "focus_ramp"
    samples: int = 0
    ways: list[VariantRow] = []
