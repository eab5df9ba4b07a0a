"""Results of the experiment `ranking`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.paper.common.results import Interval
from irlos_pipe.product.results import Number, ResultsPart, StageResults


class RankingRow(ResultsPart):
    """One method under one condition.

    Attributes
    ----------
    tail_nm : float
        RMS of every mode beyond the NCPAs' law [nm].
    method, label : str
        Key of `METHOD_NAMES`, and its name.
    modes : dict of str to Interval
        Median over the cubes of the error in Noll 2–30 [nm RMS], by the last fitted Noll mode or ``open``.
    first : dict of str to Interval
        The same with the method's own modes, by the number of frames; empty where this was not tried.
    """

    seeing_arcsec: Number = math.nan
    tail_nm: Number = math.nan
    cubes: int = 0
    method: str = ""
    label: str = ""
    modes: dict[str, Interval] = {}
    first: dict[str, Interval] = {}

    @property
    def best_nm(self) -> float:
        """Return the smallest median over the numbers of modes [nm]."""
        return min(one.value for one in self.modes.values())


class RankingResults(StageResults):
    """All methods with the same modes and frames.

    Attributes
    ----------
    frames : int
        Of a cube.
    introduced_nm : float
        Mean NCPAs of the cubes without tail, Noll 2 to 51 [nm RMS].
    introduced_scatter_nm : float
        Their standard deviation.
    """

    stage: ClassVar[str] = "ranking"
    frames: int = 0
    introduced_nm: Number = math.nan
    introduced_scatter_nm: Number = math.nan
    rows: list[RankingRow] = []
