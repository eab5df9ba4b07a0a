"""What ``irlos compare FIRST SECOND --json`` prints."""

from __future__ import annotations

import math
from typing import Any, Literal

from pydantic import Field

from irlos_pipe.product.printed import Printed
from irlos_pipe.product.results import Number, ResultsPart


class NumberPair(ResultsPart):
    """A number of results.json in two runs.

    Attributes
    ----------
    name : str
        Path in the section of the stage; rows of a list by what they are called.
    first_error, second_error : float
        Standard errors; null for a number without one.
    difference : float
        The second less the first.
    sigmas : float
        The difference in units of both errors in quadrature; null without both.
    """

    stage: str = ""
    name: str = ""
    unit: str = ""
    first: Number = math.nan
    second: Number = math.nan
    first_error: Number = math.nan
    second_error: Number = math.nan
    difference: Number = math.nan
    sigmas: Number = math.nan


class ModesPair(ResultsPart):
    """All coefficients of a wavefront in two runs.

    Attributes
    ----------
    modes : int
        How many both runs have.
    difference_nm, expected_nm : float
        RMS of the wavefront between them, and what both errors add up to.
    """

    stage: str = ""
    name: str = ""
    modes: int = 0
    difference_nm: Number = math.nan
    expected_nm: Number = math.nan


class ValuePair(ResultsPart):
    """Anything else that differs; null for what only the other run has."""

    name: str = ""
    first: Any = None
    second: Any = None


class Comparison(Printed):
    """What ``irlos compare FIRST SECOND --json`` prints.

    Attributes
    ----------
    first, second : str
        Folders of the runs.
    same_files : bool
        Whether both reduce the same files, so that their errors are not independent.
    told : list of ValuePair
        Recipe, status, and versions of the software that differ.
    settings, files : list of ValuePair
        Keys of the recipe, and input files (checksums), that differ.
    modes : list of ModesPair
        Wavefronts as a whole.
    numbers : list of NumberPair
        Every number that both runs have, also where it is the same.
    words : list of ValuePair
        Verdicts, methods and other words of results.json that differ.
    only_first, only_second : list of str
        What only one of them has.
    checks : list of ValuePair
        Checks that passed in one of them and failed in the other.
    """

    format: Literal["irlos-compare"] = Field("irlos-compare", alias="schema")
    first: str = ""
    second: str = ""
    same_files: bool = False
    told: list[ValuePair] = []
    settings: list[ValuePair] = []
    files: list[ValuePair] = []
    modes: list[ModesPair] = []
    numbers: list[NumberPair] = []
    words: list[ValuePair] = []
    only_first: list[str] = []
    only_second: list[str] = []
    checks: list[ValuePair] = []
