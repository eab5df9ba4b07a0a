"""The numbers of the suite, from the outcomes of its cases."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.diagnose_suite.cases import CLEAN, OUTSIDE, PAIR, RAMP_CLEAN, RAMP_OUTSIDE, RAMP_SINGLE
from benchmarks.diagnose_suite.groups import Singles, of_kind, sorted_singles
from benchmarks.diagnose_suite.judging import (
    EFFECT,
    NONE,
    UNKNOWN,
    Outcome,
    all_named,
    ambiguity_sets,
    extra_names,
    is_first,
    is_in_set,
    named,
)
from benchmarks.diagnose_suite.rates import Rate
from benchmarks.diagnose_suite.sizes import true_size_inside
from benchmarks.diagnose_suite.working import BIASED_NM


@dataclass(frozen=True)
class Row:
    """One number of the suite.

    Attributes
    ----------
    what : str
    aim : str
        What it should be; empty for what is only reported.
    value : Rate or float
    """

    what: str
    aim: str
    value: Rate | float

    @property
    def text(self) -> str:
        """The value, for tables."""
        if isinstance(self.value, Rate):
            return self.value.text
        return "-" if np.isnan(self.value) else f"{self.value:.3g}"


def score(outcomes: Sequence[Outcome]) -> dict[str, list[Row]]:
    """Rows of the table, by part."""
    singles = sorted_singles(outcomes)
    found = [one for one in singles.testable if is_first(one)]
    return {
        "clean": clean_rows(outcomes),
        "one effect": _singles(singles),
        "other": _others(outcomes),
        "model with what was found": _models(found),
        "ramps": _ramps(outcomes),
        "cost": cost_rows(outcomes),
    }


def clean_rows(outcomes: Sequence[Outcome]) -> list[Row]:
    """Rows of the recordings in which nothing is hidden."""
    clean = of_kind(outcomes, CLEAN)
    alarms = Row("something called missing", "<= 2 %", Rate.of(map(_is_alarm, clean)))
    settings = sorted({one["truth"]["setting"] for one in clean})
    return [alarms] + [
        Row(
            f"  {setting}", "", Rate.of(_is_alarm(one) for one in clean if one["truth"]["setting"] == setting)
        )
        for setting in settings
    ]


def _is_alarm(outcome: Outcome) -> bool:
    return outcome["diagnosis"]["verdict"] != NONE


def _singles(singles: Singles) -> list[Row]:
    testable, verdicts = singles.testable, [one for one in singles.testable if named(one)]
    sizes = [len(ambiguity_sets(one)[0]) for one in verdicts]
    return [
        Row("named first, or in a set of <= 3", ">= 97 %", Rate.of(map(is_in_set, testable))),
        Row("named first", ">= 92 %", Rate.of(map(is_first, testable))),
        Row("with a further name that is not there", "", Rate.of(bool(extra_names(o)) for o in testable)),
        Row("unknown", "", Rate.of(o["diagnosis"]["verdict"] == UNKNOWN for o in testable)),
        Row("nothing", "", Rate.of(o["diagnosis"]["verdict"] == NONE for o in testable)),
        Row("first set holds the truth", "", Rate.of(map(is_in_set, verdicts))),
        Row("mean size of the first set", "", float(np.mean(sizes)) if sizes else float("nan")),
        Row("below 3 MDB: named first", "", Rate.of(map(is_first, singles.small))),
        Row("below 3 MDB: something else", "", Rate.of(bool(extra_names(o)) for o in singles.small)),
        Row("said to be untestable", "", float(len(singles.untestable))),
    ]


def _others(outcomes: Sequence[Outcome]) -> list[Row]:
    pairs, outside = of_kind(outcomes, PAIR), of_kind(outcomes, OUTSIDE)
    return [
        Row("pairs: both named", ">= 85 %", Rate.of(map(all_named, pairs))),
        Row("pairs: a name that is not there", "", Rate.of(bool(extra_names(one)) for one in pairs)),
        *_outside_rows("outside the catalogue", outside),
    ]


def _outside_rows(what: str, outside: Sequence[Outcome]) -> list[Row]:
    return [
        Row(f"{what}: unknown", ">= 85 %", Rate.of(o["diagnosis"]["verdict"] == UNKNOWN for o in outside)),
        Row(f"{what}: a confident wrong name", "<= 10 %", Rate.of(map(_is_confident, outside))),
        Row(f"{what}: nothing", "", Rate.of(o["diagnosis"]["verdict"] == NONE for o in outside)),
    ]


def _is_confident(outcome: Outcome) -> bool:
    return outcome["diagnosis"]["verdict"] == EFFECT


def _models(found: Sequence[Outcome]) -> list[Row]:
    shrinks = [one["diagnosis"]["gap"]["shrink"] for one in found]
    inside = [verdict for verdict in map(true_size_inside, found) if verdict is not None]
    halved, alone = bias_removed(found)
    return [
        Row("held-out gap: median shrink", ">= 0.9", median_of(shrinks)),
        Row("  without one: the gap was no larger than its floor", "", float(shrinks.count(None))),
        Row("true size in the 95 % interval", ">= 85 %", Rate.of(inside)),
        Row("NCPA error halved where biased > 5 nm", "all", Rate.of(halved)),
        Row("  the bias alone halved", "", Rate.of(alone)),
    ]


def median_of(values: Sequence[float | None]) -> float:
    """Median of the values that are known; NaN without any."""
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else float("nan")


def bias_removed(found: Sequence[Outcome]) -> tuple[list[bool], list[bool]]:
    """Whether the error of the NCPAs is at most half of that without the name, where the effect biased them.

    The bias is the difference from a fit of the same frames with the true model.

    Returns
    -------
    list of bool
        For the whole error.
    list of bool
        For the bias alone.
    """
    biased = [one for one in found if one["ncpa_bias_nm"] and one["ncpa_bias_nm"]["before"] > BIASED_NM]
    kinds = ("ncpa_error_nm", "ncpa_bias_nm")
    return tuple([one[kind]["after"] <= one[kind]["before"] / 2 for one in biased] for kind in kinds)


def _ramps(outcomes: Sequence[Outcome]) -> list[Row]:
    clean, singles = of_kind(outcomes, RAMP_CLEAN), sorted_singles(outcomes, RAMP_SINGLE, RAMP_CLEAN)
    return [
        Row("clean ramps: something called missing", "<= 2 %", Rate.of(map(_is_alarm, clean))),
        *_singles(singles),
        *_outside_rows("frames in another order", of_kind(outcomes, RAMP_OUTSIDE)),
    ]


def cost_rows(outcomes: Sequence[Outcome]) -> list[Row]:
    """Rows of the time that it took."""
    stages = ("simulate", "diagnose")
    rows = [Row(f"CPU s to {s}, median", "", median_of([o["cpu_s"][s] for o in outcomes])) for s in stages]
    return [
        *rows,
        Row("seconds per diagnosis, median", "", median_of([o["diagnosis"]["seconds"] for o in outcomes])),
    ]
