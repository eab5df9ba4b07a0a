"""Results of the experiment `faint`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.product.results import Number, ResultsPart, StageResults
from irlos_pipe.stages.sensitivity.stage import CriterionRow, CurveRow


class VariantCurve(CurveRow):
    """The curve of one variant of LIFT, all samples pooled.

    Attributes
    ----------
    key : str
        Of `LIFT_VARIANTS`.
    """

    key: str = ""
    label: str = ""

    @property
    def kind(self) -> str:
        """Return the key without the number of modes."""
        return self.key.rpartition("_")[0]


class ExposureGroup(ResultsPart):
    """The curves of one length of exposure.

    Attributes
    ----------
    residual_floor_nm : float
        Median absolute error of a perfect sensor [nm RMS].
    """

    exposure_s: Number = math.nan
    residual_floor_nm: Number = math.nan
    curves: list[VariantCurve] = []


class FaintCriterion(CriterionRow):
    """The criterion, and the error [nm RMS] above which an estimate counts as failed."""

    implausible_nm: Number = math.nan


class FaintResults(StageResults):
    """How faint LIFT goes."""

    stage: ClassVar[str] = "faint"
    samples: int = 0
    exposures: list[ExposureGroup] = []
    criterion: FaintCriterion = FaintCriterion()
    crb_note: str = ""
