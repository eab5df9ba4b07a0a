"""What ``irlos compare FIRST SECOND --json`` prints."""

from __future__ import annotations

from math import nan
from typing import Any, Literal

from pydantic import Field

from irlos_pipe.product.printed import Printed
from irlos_pipe.product.results import DITTO, Number, ResultsPart, item


class NumberPair(ResultsPart):
    """A number of results.json in two runs."""

    stage: str = ""
    name: str = item("", "Path in the section of the stage; rows of a list by what they are called.")
    unit: str = ""
    first: Number = nan
    second: Number = nan
    first_error: Number = item(nan, "Standard errors; null for a number without one.")
    second_error: Number = item(nan, DITTO)
    difference: Number = item(nan, "The second less the first.")
    sigmas: Number = item(nan, "The difference in units of both errors in quadrature; null without both.")


class ModesPair(ResultsPart):
    """All coefficients of a wavefront in two runs."""

    stage: str = ""
    name: str = ""
    modes: int = item(0, "How many both runs have.")
    difference_nm: Number = item(nan, "RMS of the wavefront between them, and what both errors add up to.")
    expected_nm: Number = item(nan, DITTO)


class ValuePair(ResultsPart):
    """Anything else that differs; null for what only the other run has."""

    name: str = ""
    first: Any = None
    second: Any = None


class Comparison(Printed):
    """What ``irlos compare FIRST SECOND --json`` prints."""

    format: Literal["irlos-compare"] = Field("irlos-compare", alias="schema")
    first: str = item("", "Folders of the runs.")
    second: str = item("", DITTO)
    same_files: bool = item(
        False, "Whether both reduce the same files, so that their errors are not independent."
    )
    told: list[ValuePair] = item([], "Recipe, status, and versions of the software that differ.")
    settings: list[ValuePair] = item([], "Keys of the recipe, and input files (checksums), that differ.")
    files: list[ValuePair] = item([], DITTO)
    modes: list[ModesPair] = item([], "Wavefronts as a whole.")
    numbers: list[NumberPair] = item([], "Every number that both runs have, also where it is the same.")
    words: list[ValuePair] = item([], "Verdicts, methods and other words of results.json that differ.")
    only_first: list[str] = item([], "What only one of them has.")
    only_second: list[str] = item([], DITTO)
    checks: list[ValuePair] = item([], "Checks that passed in one of them and failed in the other.")
