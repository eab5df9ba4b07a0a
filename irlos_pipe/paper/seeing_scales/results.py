"""Results of the experiment `seeing_scales`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.conventions.laws import ResidualLaw
from irlos_pipe.conventions.seeing import SeeingScale
from irlos_pipe.paper.common.results import Percentiles
from irlos_pipe.product.results import Number, ResultsPart, StageResults


class Relation(ResultsPart):
    """SPARTA's seeing = ratio · monitor's seeing + offset, and how well this is known."""

    ratio: Number = math.nan
    offset_arcsec: Number = math.nan
    status: str = ""
    source: str = ""

    @property
    def scale(self) -> SeeingScale:
        """Return the relation as a scale."""
        return SeeingScale(self.ratio, self.offset_arcsec)


class ConditionRow(ResultsPart):
    """One seeing on both scales and the residual WFE that the law gives for each.

    Attributes
    ----------
    where : str
        ``simulation`` or ``sky``.
    better : float
        Part of the time in which SPARTA's seeing is better than this.
    wfe_nm, wfe_sigma_nm : float
        From SPARTA's seeing, and its scatter where only the monitor's is known [nm RMS].
    wfe_untranslated_nm : float
        From the monitor's seeing taken for SPARTA's [nm RMS].
    """

    where: str = ""
    sparta_arcsec: Number = math.nan
    monitor_arcsec: Number = math.nan
    better: Number = math.nan
    wfe_nm: Number = math.nan
    wfe_sigma_nm: Number = math.nan
    wfe_untranslated_nm: Number = math.nan


class Distributions(ResultsPart):
    """Median and one-sigma range on both scales, and of the residual [nm RMS]."""

    draws: int = 0
    monitor_arcsec: Percentiles = Percentiles()
    sparta_arcsec: Percentiles = Percentiles()
    wfe_nm: Percentiles = Percentiles()
    wfe_untranslated_nm: Percentiles = Percentiles()


class SeeingScalesResults(StageResults):
    """SPARTA's seeing against that of a monitor."""

    stage: ClassVar[str] = "seeing_scales"
    monitor: str = ""
    relation: Relation = Relation()
    residual_law: ResidualLaw = ResidualLaw(math.nan, math.nan)
    conditions: list[ConditionRow] = []
    distributions: Distributions = Distributions()
