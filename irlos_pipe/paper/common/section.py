"""What the sections of several experiments share."""

from __future__ import annotations

import numpy as np

from irlos_pipe.paper.common.results import Interval, Percentiles
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number


def array_of(run: RunData, stage: str, name: str) -> np.ndarray:
    """Return the array `name` of the product of a `stage` of the `run`, which must be there."""
    return np.asarray(run.products[stage].arrays[name].value)


def spread(found: Percentiles, pattern: str = ".1f") -> str:
    """Return a median with its one-sigma range, as a table has it.

    Parameters
    ----------
    found : Percentiles
    pattern : str
        Format of each number.
    """
    median, p16, p84 = (number(value, pattern) for value in (found.median, found.p16, found.p84))
    return f"{median} ({p16}…{p84})"


def interval(found: Interval) -> str:
    """Return a number with its range, as a table has it."""
    value, low, high = (number(one, ".1f") for one in (found.value, found.low, found.high))
    return f"{value} ({low}…{high})"


def mark(error: float, asked: float) -> str:
    """Return how a row of a table is marked.

    Parameters
    ----------
    error : float
    asked : float
        Largest error that is good, in the same unit; NaN where nothing is asked and nothing is marked.
    """
    if not np.isfinite(asked):
        return ""
    return "good" if error <= asked else "bad"
