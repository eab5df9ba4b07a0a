"""Results of the experiment `mirror_loop`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.paper.common.results import Percentiles
from irlos_pipe.product.results import Number, ResultsPart, StageResults


class StateRow(ResultsPart):
    """The wavefront after some corrections, over the samples whose loop came that far.

    Attributes
    ----------
    corrections, samples : int
    modes_nm, beyond_nm, all_nm : Percentiles
        True wavefront left in Noll 4–30, in all that these are not, and of both together.
    strehl : Percentiles
        Of the star without diversity at 1600 nm.
    seen_nm : Percentiles
        RMS of the estimate in Noll 4–30.
    """

    corrections: int = 0
    samples: int = 0
    modes_nm: Percentiles = Percentiles()
    beyond_nm: Percentiles = Percentiles()
    all_nm: Percentiles = Percentiles()
    strehl: Percentiles = Percentiles()
    seen_nm: Percentiles = Percentiles()


class LoopRow(ResultsPart):
    """One loop on stars with one bias of the defocus; medians and spreads over the samples.

    Attributes
    ----------
    method : str
    diversity : {"exact", "mirror"}
        As declared, or made by the same mirror with the same errors.
    bias_nm : float
    introduced_nm : Percentiles
        RMS of the wavefront before, without tip and tilt.
    states : list of StateRow
        Before the first correction and after each.
    corrections : Percentiles
        Until the estimate fell no more.
    most_corrections : int
    cut_off : int
        Loops in which the estimate still fell at the last correction that was allowed.
    before_nm, end_nm, beyond_nm, all_nm : Percentiles
        In Noll 4–30 before and at the end, and at the end in all other modes, and altogether.
    strehl_before, strehl_end, strehl_ideal, strehl_predicted : Percentiles
        Of the star without diversity; ideal: without NCPAs; predicted: by the stage `correct`, of the first
        correction.
    part_nm, part_beyond_nm : dict of str to float
        Medians of what is left at the end in Noll 4–30, and beyond, by cause: modes finer than the corrected
        ones, fitting error of the mirror, its gain and registration, error of the diversity, estimates.
    limit : str
        The largest of them in Noll 4–30.
    asked_nm, worst_nm : float
        Limit of all samples in `end_nm`, NaN where there is none, and the largest of them.
    """

    method: str = ""
    diversity: str = ""
    bias_nm: Number = math.nan
    introduced_nm: Percentiles = Percentiles()
    states: list[StateRow] = []
    corrections: Percentiles = Percentiles()
    most_corrections: int = 0
    cut_off: int = 0
    before_nm: Percentiles = Percentiles()
    end_nm: Percentiles = Percentiles()
    beyond_nm: Percentiles = Percentiles()
    all_nm: Percentiles = Percentiles()
    strehl_before: Percentiles = Percentiles()
    strehl_end: Percentiles = Percentiles()
    strehl_ideal: Percentiles = Percentiles()
    strehl_predicted: Percentiles = Percentiles()
    part_nm: dict[str, Number] = {}
    part_beyond_nm: dict[str, Number] = {}
    limit: str = ""
    asked_nm: Number = math.nan
    worst_nm: Number = math.nan


class AloneRow(ResultsPart):
    """A mirror that is told the truth; medians over all samples.

    Attributes
    ----------
    pitch_m : float
    actuators : int
    error : str
        Which of its errors it has.
    modes_nm : list of float
        Left in Noll 4–30 before the first correction and after each.
    beyond_nm : float
        Left in all other modes in the end.
    """

    pitch_m: Number = math.nan
    actuators: int = 0
    error: str = ""
    modes_nm: list[Number] = []
    beyond_nm: Number = math.nan


class MirrorLoopResults(StageResults):
    """What a mirror with errors leaves of NCPAs that are calibrated again after every correction."""

    stage: ClassVar[str] = "mirror_loop"
    samples: int = 0
    rows: list[LoopRow] = []
    alone: list[AloneRow] = []
