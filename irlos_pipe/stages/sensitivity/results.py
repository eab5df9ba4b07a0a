"""Results of stage `sensitivity`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.product.results import Number, ResultsPart, StageResults


class CurveRow(ResultsPart):
    """One curve over the magnitudes `mag_j`.

    Attributes
    ----------
    calibrated : bool
        Whether the NCPAs are part of the known wavefront.
    modes : list of int
        Estimated modes (Noll).
    median_abs_error_nm, p16_nm, p84_nm : list of float
        Percentiles of |estimated − introduced| defocus.
    crb_nm : list of float
        Cramér–Rao bound, 1σ.
    failures : list of int
        Estimates that failed, of `trials` per magnitude.
    limit_mag : float
        Faintest magnitude that meets the criterion; NaN if none does.
    """

    calibrated: bool = False
    modes: list[int] = []
    mag_j: list[Number] = []
    median_abs_error_nm: list[Number] = []
    p16_nm: list[Number] = []
    p84_nm: list[Number] = []
    crb_nm: list[Number] = []
    failures: list[int] = []
    trials: int | None = None
    limit_mag: Number = math.nan

    @property
    def at_the_end(self) -> bool:
        """Whether the magnitudes end before the criterion is missed."""
        return bool(self.mag_j) and self.limit_mag == self.mag_j[-1]


class CriterionRow(ResultsPart):
    """What a limiting magnitude keeps: largest median error, and largest part of failures."""

    median_abs_error_nm: Number = math.nan
    failures: Number = math.nan


class SensitivityResults(StageResults):
    """One curve per combination of modes and calibration."""

    stage: ClassVar[str] = "sensitivity"
    curves: list[CurveRow] = []
    criterion: CriterionRow = CriterionRow()
    crb_note: str = ""
