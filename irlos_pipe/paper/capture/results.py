"""Results of the experiment `capture`."""

from __future__ import annotations

import math
from typing import ClassVar

from irlos_pipe.product.results import Number, ResultsPart, StageResults


class Counts(ResultsPart):
    """Cases, and how many of them were captured, wrong, or flagged as failed."""

    cases: int = 0
    captured: int = 0
    wrong: int = 0
    flagged: int = 0


class StartRow(ResultsPart):
    """LIFT from one start.

    Attributes
    ----------
    start : str
        Of `STARTS`.
    required, all : Counts
        Within the required range of defocus, and of all cases.
    range_nm : float
        Defocus up to which every case was captured.
    rms_nm : float
        RMS error of the captured cases within the required range.
    largest_right_nm, smallest_wrong_nm : float
        Largest error of the captured and smallest of the wrong cases; NaN without any.
    captured_per_bin, cases_per_bin : list of int
    """

    start: str = ""
    required: Counts = Counts()
    all: Counts = Counts()
    range_nm: Number = math.nan
    rms_nm: Number = math.nan
    largest_right_nm: Number = math.nan
    smallest_wrong_nm: Number = math.nan
    captured_per_bin: list[int] = []
    cases_per_bin: list[int] = []


class CaptureResults(StageResults):
    """From how far LIFT finds the defocus, by where it starts.

    Attributes
    ----------
    wrong_limit_nm : float
        Error above which an estimate is wrong.
    required_nm, paper_nm : float
        Capture range that is asked for, and the one that the paper states.
    bin_edges_nm : list of float
        Of true defocus.
    h_cases : int
    h_starts : list of StartRow
        In H alone with the NCPAs known exactly, the conditions for which the paper states a range.
    """

    stage: ClassVar[str] = "capture"
    cases: int = 0
    wrong_limit_nm: Number = math.nan
    required_nm: Number = math.nan
    paper_nm: Number = math.nan
    mag_j: Number = math.nan
    bin_edges_nm: list[Number] = []
    starts: list[StartRow] = []
    h_cases: int = 0
    h_starts: list[StartRow] = []
