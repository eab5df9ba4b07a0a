"""Results of the experiment `correction_gain`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.product.results import Number, ResultsPart, StageResults


class SeeingRow(ResultsPart):
    """Medians over the stars of one seeing.

    Attributes
    ----------
    strehl : dict of str to float
        Strehl ratio at 1600 nm by state: before, by method, ideal.
    delta_wfe_nm : dict of str to float
        Δ-WFE over the full pupil by method [nm RMS].
    won : dict of str to float
        Part of the Strehl ratio that a perfect correction would gain, by method.
    """

    seeing_arcsec: Number = math.nan
    samples: int = 0
    strehl: dict[str, Number] = {}
    delta_wfe_nm: dict[str, Number] = {}
    won: dict[str, Number] = {}


class CorrectionGainResults(StageResults):
    """Strehl ratio before and after the correction."""

    stage: ClassVar[str] = "correction_gain"
    seeings: list[SeeingRow] = []
