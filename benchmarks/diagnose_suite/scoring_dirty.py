"""The numbers of the suite where everything has a mild error beside what is hidden."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.diagnose_suite.cases import CLEAN, OUTSIDE, PAIR, RAMP_CLEAN, RAMP_OUTSIDE, RAMP_SINGLE
from benchmarks.diagnose_suite.groups import Singles, in_world, of_kind, smallest_sizes, sorted_singles
from benchmarks.diagnose_suite.judging import (
    GRADES,
    Outcome,
    all_named,
    first_is_wrong,
    grade,
    is_first,
    is_in_some_set,
    is_named,
    named,
    wrong_names,
)
from benchmarks.diagnose_suite.rates import Rate
from benchmarks.diagnose_suite.scoring import Row, clean_rows, cost_rows, median_of


def score_dirty(outcomes: Sequence[Outcome]) -> dict[str, list[Row]]:
    """Rows of the table, by part; those of the clean recordings that give the smallest sizes come first."""
    dirty = in_world(outcomes, dirty=True)
    singles = sorted_singles(outcomes, dirty=True)
    as_if_clean = sorted_singles(outcomes, dirty=True, smallest=smallest_sizes(outcomes))
    ramps = sorted_singles(outcomes, RAMP_SINGLE, RAMP_CLEAN, dirty=True)
    return {
        "without mild errors": clean_rows(in_world(outcomes, dirty=False)),
        "one effect beside mild errors": _singles(singles),
        "one effect beside mild errors, from 3 MDB without these on": _singles(as_if_clean),
        "one effect beside mild errors, by grade": _grades(singles.testable),
        "other, beside mild errors": _others(dirty),
        "gap": _gaps(dirty),
        "ramps, beside mild errors": _singles(ramps)
        + _wrong("ramps with nothing hidden", dirty, RAMP_CLEAN)
        + _wrong("frames in another order", dirty, RAMP_OUTSIDE),
        "cost": cost_rows(dirty),
    }


def _singles(singles: Singles) -> list[Row]:
    testable, small = singles.testable, singles.small
    return [
        Row("named", ">= 90 %", Rate.of(map(is_named, testable))),
        Row("  named, or in a set of <= 3", "", Rate.of(map(is_in_some_set, testable))),
        Row("named first", ">= 80 %", Rate.of(map(is_first, testable))),
        Row("wrong first name", "<= 5 %", Rate.of(map(first_is_wrong, testable))),
        Row("some wrong name", "", Rate.of(bool(wrong_names(one)) for one in testable)),
        Row("no name", "", Rate.of(not named(one) for one in testable)),
        Row("below 3 MDB: named", "", Rate.of(map(is_named, small))),
        Row("below 3 MDB: wrong first name", "", Rate.of(map(first_is_wrong, small))),
        Row("said to be untestable", "", float(len(singles.untestable))),
    ]


def _grades(singles: Sequence[Outcome]) -> list[Row]:
    """How many have each grade, and how many of these are named or misnamed."""
    rows = []
    for one in GRADES:
        graded = [outcome for outcome in singles if grade(outcome) == one]
        rows += [
            Row(one, "", Rate.of(grade(outcome) == one for outcome in singles)),
            Row("  named", "", Rate.of(map(is_named, graded))),
            Row("  named first", "", Rate.of(map(is_first, graded))),
            Row("  wrong first name", "", Rate.of(map(first_is_wrong, graded))),
        ]
    return rows


def _others(dirty: Sequence[Outcome]) -> list[Row]:
    return [
        *_wrong("nothing hidden", dirty, CLEAN),
        Row("pairs: both named", "", Rate.of(map(all_named, of_kind(dirty, PAIR)))),
        *_wrong("pairs", dirty, PAIR),
        *_wrong("outside the catalogue", dirty, OUTSIDE),
    ]


def _wrong(what: str, dirty: Sequence[Outcome], kind: str) -> list[Row]:
    return [Row(f"{what}: wrong first name", "", Rate.of(map(first_is_wrong, of_kind(dirty, kind))))]


def _gaps(dirty: Sequence[Outcome]) -> list[Row]:
    """Of the cubes and ramps whose diagnosis states one."""
    gaps = [one["diagnosis"]["gap"] for one in dirty]
    errors = [one["ncpa_error_nm"] for one in dirty if one["ncpa_error_nm"]]
    return [
        *(
            Row(f"{key}, median", "", median_of([gap.get(key) for gap in gaps]))
            for key in ("before", "after", "floor")
        ),
        *(
            Row(f"NCPA error {key}, nm, median", "", median_of([error[key] for error in errors]))
            for key in ("before", "after")
        ),
    ]
