"""Which hidden effect was called what."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.diagnose_suite.cases import CLEAN, OUTSIDE, RAMP_CLEAN, RAMP_OUTSIDE, RAMP_SINGLE, SINGLE
from benchmarks.diagnose_suite.hidden import DRAWS
from benchmarks.diagnose_suite.judging import EFFECT, NONE, UNKNOWN, Outcome, is_untestable, named
from irlos_pipe.effects import CATALOGUE

KINDS = (CLEAN, SINGLE, OUTSIDE, RAMP_CLEAN, RAMP_SINGLE, RAMP_OUTSIDE)
NOTHING, NOT_IN_CATALOGUE, UNTESTABLE = "(nothing)", "(outside)", "(untestable)"
CELL_IN = 0.32  # of the figure


@dataclass(frozen=True)
class Confusion:
    """Counts by truth (rows) and verdict (columns).

    Attributes
    ----------
    rows, columns : tuple of str
    counts : ndarray of int, (rows, columns)
    """

    rows: tuple[str, ...]
    columns: tuple[str, ...]
    counts: np.ndarray

    @classmethod
    def of(cls, outcomes: Sequence[Outcome]) -> Confusion:
        """Of the cases with at most one hidden effect; pairs have no row."""
        rows = (NOTHING, *DRAWS, NOT_IN_CATALOGUE)
        columns = (*CATALOGUE, UNTESTABLE, NONE, UNKNOWN)
        counts = np.zeros((len(rows), len(columns)), int)
        for one in outcomes:
            if one["truth"]["kind"] in KINDS:
                counts[rows.index(true_name(one)), columns.index(called(one))] += 1
        return cls(rows, columns, counts)

    def as_json(self) -> dict[str, list]:
        """For scripts."""
        return {"truth": list(self.rows), "called": list(self.columns), "counts": self.counts.tolist()}


def true_name(outcome: Outcome) -> str:
    """Row of a case."""
    hidden = outcome["truth"]["effects"]
    if not hidden:
        return NOTHING
    return hidden[0] if hidden[0] in DRAWS else NOT_IN_CATALOGUE


def called(outcome: Outcome) -> str:
    """Column of a case: the first name, or the verdict."""
    if is_untestable(outcome):
        return UNTESTABLE
    return named(outcome)[0] if outcome["diagnosis"]["verdict"] == EFFECT else outcome["diagnosis"]["verdict"]


def draw_confusion(confusion: Confusion, path: Path) -> None:
    """Write the matrix as a picture; shades are parts of a row."""
    figure = Figure(figsize=(4 + CELL_IN * len(confusion.columns), 3 + CELL_IN * len(confusion.rows)))
    axes = figure.add_subplot()
    parts = confusion.counts / np.maximum(confusion.counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(parts, cmap="Blues", vmin=0, vmax=1.3)
    axes.set_xticks(range(len(confusion.columns)), confusion.columns, rotation=60, ha="right")
    axes.set_yticks(range(len(confusion.rows)), confusion.rows)
    axes.set_xlabel("first name, or verdict")
    axes.set_ylabel("hidden effect")
    for row, column in np.argwhere(confusion.counts):
        axes.text(column, row, confusion.counts[row, column], ha="center", va="center", fontsize=8)
    figure.savefig(path, dpi=120, bbox_inches="tight")
