"""Results of the experiment `mode_number`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.product.results import Number, ResultsPart, StageResults


class NumberCurve(ResultsPart):
    """Δ-WFE in Noll 2–30 of one method at one magnitude; lists are over the numbers of modes.

    Attributes
    ----------
    median_nm, least_nm, worst_nm : list of float
        Over the cubes [nm RMS].
    best_noll : int
        Highest mode of the number with the least median error, which is `best_nm`.
    """

    method: str = ""
    mag_j: Number = math.nan
    median_nm: list[Number] = []
    least_nm: list[Number] = []
    worst_nm: list[Number] = []
    best_noll: int = 0
    best_nm: Number = math.nan


class ModeNumberResults(StageResults):
    """Error against the number of estimated modes.

    Attributes
    ----------
    highest_noll : list of int
        Numbers of modes that were tried: Noll 2 to each of these.
    recommended_noll : list of int
        For every cube the number that held-out frames recommend to the default.
    """

    stage: ClassVar[str] = "mode_number"
    cubes: int = 0
    modes_introduced: int = 0
    highest_noll: list[int] = []
    curves: list[NumberCurve] = []
    recommended_noll: list[int] = []
