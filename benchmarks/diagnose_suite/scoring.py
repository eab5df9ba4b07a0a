"""What the suite reports: a table for people, `suite.json` and `confusion.png` for everything else."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from benchmarks.diagnose_suite.cases import (
    CLEAN,
    OUTSIDE,
    PAIR,
    RAMP_CLEAN,
    RAMP_OUTSIDE,
    RAMP_SINGLE,
    SINGLE,
    SIZES,
)
from benchmarks.diagnose_suite.judging import (
    EFFECT,
    GRADES,
    NONE,
    UNKNOWN,
    Singles,
    all_named,
    ambiguity_sets,
    extra_names,
    first_is_wrong,
    grade,
    in_smallest,
    in_world,
    is_dirty,
    is_first,
    is_in_set,
    is_in_some_set,
    is_named,
    is_right,
    is_untestable,
    named,
    of_kind,
    smallest_sizes,
    sorted_singles,
    true_size_inside,
    wrong_names,
)
from benchmarks.harness import Outcome, Rate
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text

RESULTS, PICTURE = "suite.json", "confusion.png"
BIASED_NM = 5.0  # error of the NCPAs from which an effect counts as having biased them
CELL_IN = 0.32  # size of a cell of the figure [inch]
# Kinds of cases in the matrix, its rows (what is hidden) and columns (what was called).
KINDS = (CLEAN, SINGLE, OUTSIDE, RAMP_CLEAN, RAMP_SINGLE, RAMP_OUTSIDE)
NOTHING, NOT_IN_CATALOGUE, UNTESTABLE = "(nothing)", "(outside)", "(untestable)"
HIDDEN = (NOTHING, *SIZES, NOT_IN_CATALOGUE)
CALLED = (*CATALOGUE, UNTESTABLE, NONE, UNKNOWN)


class Row(NamedTuple):
    """One number of the suite, and what it should be; nothing for what is only reported."""

    what: str
    value: Rate | float
    aim: str = ""

    @property
    def text(self) -> str:
        """The value, for tables."""
        if isinstance(self.value, Rate):
            return self.value.text
        return "-" if np.isnan(self.value) else f"{self.value:.3g}"


def rate(what: str, is_so: Callable[[Outcome], Any], outcomes: Iterable[Outcome], aim: str = "") -> Row:
    """How many `outcomes` are so."""
    return Row(what, Rate.of(map(is_so, outcomes)), aim)


def median(what: str, values: Iterable[float | None], aim: str = "") -> Row:
    """Median of the values that are known; NaN without any."""
    known = [value for value in values if value is not None]
    return Row(what, float(np.median(known)) if known else float("nan"), aim)


def has_verdict(*verdicts: str) -> Callable[[Outcome], bool]:
    """Whether an outcome has one of these."""
    return lambda outcome: outcome["diagnosis"]["verdict"] in verdicts


def score(outcomes: Sequence[Outcome]) -> dict[str, list[Row]]:
    """Rows of the table, by part."""
    singles = sorted_singles(outcomes)
    pairs, ramps = of_kind(outcomes, PAIR), sorted_singles(outcomes, RAMP_SINGLE, RAMP_CLEAN)
    alarm = has_verdict(EFFECT, UNKNOWN)
    return {
        "clean": _clean(outcomes),
        "one effect": _singles(singles),
        "other": [
            rate("pairs: both named", all_named, pairs, ">= 85 %"),
            rate("pairs: a name that is not there", extra_names, pairs),
            *_outside("outside the catalogue", of_kind(outcomes, OUTSIDE)),
        ],
        "model with what was found": _models([one for one in singles.testable if is_first(one)]),
        "ramps": [
            rate("clean ramps: something called missing", alarm, of_kind(outcomes, RAMP_CLEAN), "<= 2 %"),
            *_singles(ramps),
            *_outside("frames in another order", of_kind(outcomes, RAMP_OUTSIDE)),
        ],
        "cost": _cost(outcomes),
    }


def _clean(outcomes: Sequence[Outcome]) -> list[Row]:
    """Recordings in which nothing is hidden."""
    clean, alarm = of_kind(outcomes, CLEAN), has_verdict(EFFECT, UNKNOWN)
    rows = [rate("something called missing", alarm, clean, "<= 2 %")]
    for setting in sorted({one["truth"]["setting"] for one in clean}):
        rows.append(rate(f"  {setting}", alarm, [one for one in clean if one["truth"]["setting"] == setting]))
    return rows


def _singles(singles: Singles) -> list[Row]:
    testable, verdicts = singles.testable, [one for one in singles.testable if named(one)]
    sizes = [len(ambiguity_sets(one)[0]) for one in verdicts]
    return [
        rate("named first, or in a set of <= 3", is_in_set, testable, ">= 97 %"),
        rate("named first", is_first, testable, ">= 92 %"),
        rate("with a further name that is not there", extra_names, testable),
        rate("unknown", has_verdict(UNKNOWN), testable),
        rate("nothing", has_verdict(NONE), testable),
        rate("first set holds the truth", is_in_set, verdicts),
        Row("mean size of the first set", float(np.mean(sizes)) if sizes else float("nan")),
        rate("below 3 MDB: named first", is_first, singles.small),
        rate("below 3 MDB: something else", extra_names, singles.small),
        Row("said to be untestable", float(len(singles.untestable))),
    ]


def _outside(what: str, outside: Sequence[Outcome]) -> list[Row]:
    return [
        rate(f"{what}: unknown", has_verdict(UNKNOWN), outside, ">= 85 %"),
        rate(f"{what}: a confident wrong name", has_verdict(EFFECT), outside, "<= 10 %"),
        rate(f"{what}: nothing", has_verdict(NONE), outside),
    ]


def _models(found: Sequence[Outcome]) -> list[Row]:
    shrinks = [one["diagnosis"]["gap"]["shrink"] for one in found]
    inside = [verdict for verdict in map(true_size_inside, found) if verdict is not None]
    biased = [one for one in found if one["ncpa_bias_nm"] and one["ncpa_bias_nm"]["before"] > BIASED_NM]
    return [
        median("held-out gap: median shrink", shrinks, ">= 0.9"),
        Row("  without one: the gap was no larger than its floor", float(shrinks.count(None))),
        Row("true size in the 95 % interval", Rate.of(inside), ">= 85 %"),
        rate("NCPA error halved where biased > 5 nm", _halved("ncpa_error_nm"), biased, "all"),
        # The bias is the difference from a fit of the same frames with the true model.
        rate("  the bias alone halved", _halved("ncpa_bias_nm"), biased),
    ]


def _halved(key: str) -> Callable[[Outcome], bool]:
    return lambda outcome: outcome[key]["after"] <= outcome[key]["before"] / 2


def _cost(outcomes: Sequence[Outcome]) -> list[Row]:
    return [
        median("CPU s to simulate, median", [one["cpu_s"]["simulate"] for one in outcomes]),
        median("CPU s to diagnose, median", [one["cpu_s"]["diagnose"] for one in outcomes]),
        median("seconds per diagnosis, median", [one["diagnosis"]["seconds"] for one in outcomes]),
    ]


# -- where everything has a mild error besides what is hidden -----------------------------------


def score_dirty(outcomes: Sequence[Outcome]) -> dict[str, list[Row]]:
    """Rows of the table, by part; those of the clean recordings that give the smallest sizes come first."""
    dirty = in_world(outcomes, dirty=True)
    singles = sorted_singles(outcomes, dirty=True)
    as_if_clean = sorted_singles(outcomes, dirty=True, smallest=smallest_sizes(outcomes))
    ramps = sorted_singles(outcomes, RAMP_SINGLE, RAMP_CLEAN, dirty=True)

    def wrong(what: str, kind: str) -> Row:
        return rate(f"{what}: wrong first name", first_is_wrong, of_kind(dirty, kind))

    return {
        "without mild errors": _clean(in_world(outcomes, dirty=False)),
        "one effect beside mild errors": _with_mild_errors(singles),
        "one effect beside mild errors, from 3 MDB without these on": _with_mild_errors(as_if_clean),
        "one effect beside mild errors, by grade": [
            row for one in GRADES for row in _of_grade(one, singles.testable)
        ],
        "other, beside mild errors": [
            wrong("nothing hidden", CLEAN),
            rate("pairs: both named", all_named, of_kind(dirty, PAIR)),
            wrong("pairs", PAIR),
            wrong("outside the catalogue", OUTSIDE),
        ],
        "gap": _gaps(dirty),
        "ramps, beside mild errors": [
            *_with_mild_errors(ramps),
            wrong("ramps with nothing hidden", RAMP_CLEAN),
            wrong("frames in another order", RAMP_OUTSIDE),
        ],
        "cost": _cost(dirty),
    }


def _with_mild_errors(singles: Singles) -> list[Row]:
    testable, small = singles.testable, singles.small
    return [
        rate("named", is_named, testable, ">= 90 %"),
        rate("  named, or in a set of <= 3", is_in_some_set, testable),
        rate("named first", is_first, testable, ">= 80 %"),
        rate("wrong first name", first_is_wrong, testable, "<= 5 %"),
        rate("some wrong name", wrong_names, testable),
        rate("no name", lambda one: not named(one), testable),
        rate("below 3 MDB: named", is_named, small),
        rate("below 3 MDB: wrong first name", first_is_wrong, small),
        Row("said to be untestable", float(len(singles.untestable))),
    ]


def _of_grade(wanted: str, singles: Sequence[Outcome]) -> list[Row]:
    """How many have a grade, and how many of these are named or misnamed."""
    graded = [one for one in singles if grade(one) == wanted]
    return [
        rate(wanted, lambda one: grade(one) == wanted, singles),
        rate("  named", is_named, graded),
        rate("  named first", is_first, graded),
        rate("  wrong first name", first_is_wrong, graded),
    ]


def _gaps(dirty: Sequence[Outcome]) -> list[Row]:
    """Of the cubes and ramps whose diagnosis states one."""
    gaps = [one["diagnosis"]["gap"] for one in dirty]
    errors = [one["ncpa_error_nm"] for one in dirty if one["ncpa_error_nm"]]
    of_gaps = (median(f"{k}, median", [gap.get(k) for gap in gaps]) for k in ("before", "after", "floor"))
    of_ncpa = (median(f"NCPA error {k}, nm, median", [one[k] for one in errors]) for k in ("before", "after"))
    return [*of_gaps, *of_ncpa]


# -- which hidden effect was called what -------------------------------------------------------


def confusion(outcomes: Sequence[Outcome]) -> np.ndarray:
    """Count the cases with at most one hidden effect, (`HIDDEN`, `CALLED`); pairs have no row."""
    counts = np.zeros((len(HIDDEN), len(CALLED)), int)
    for one in outcomes:
        if one["truth"]["kind"] in KINDS:
            name = one["truth"]["effects"][0] if one["truth"]["effects"] else NOTHING
            row = HIDDEN.index(name if name in HIDDEN else NOT_IN_CATALOGUE)
            counts[row, CALLED.index(called(one))] += 1
    return counts


def called(outcome: Outcome) -> str:
    """Column of a case: the first name, or the verdict."""
    if is_untestable(outcome):
        return UNTESTABLE
    return named(outcome)[0] if outcome["diagnosis"]["verdict"] == EFFECT else outcome["diagnosis"]["verdict"]


def _draw(counts: np.ndarray, path: Path) -> None:
    """Write the matrix as a picture; shades are parts of a row."""
    figure = Figure(figsize=(4 + CELL_IN * len(CALLED), 3 + CELL_IN * len(HIDDEN)))
    axes = figure.add_subplot()
    axes.imshow(counts / np.maximum(counts.sum(axis=1, keepdims=True), 1), cmap="Blues", vmin=0, vmax=1.3)
    axes.set_xticks(range(len(CALLED)), CALLED, rotation=60, ha="right")
    axes.set_yticks(range(len(HIDDEN)), HIDDEN)
    axes.set_xlabel("first name, or verdict")
    axes.set_ylabel("hidden effect")
    for row, column in np.argwhere(counts):
        axes.text(column, row, counts[row, column], ha="center", va="center", fontsize=8)
    figure.savefig(path, dpi=120, bbox_inches="tight")


# -- the report --------------------------------------------------------------------------------


def write_report(outcomes: Sequence[Outcome], failed: Mapping[str, str], folder: Path) -> str:
    """Write both files into a folder; returns the table; `failed` says what stopped other cases, by name."""
    outcomes = sorted(outcomes, key=lambda one: one["case"])
    dirty = in_world(outcomes, dirty=True)
    parts = score_dirty(outcomes) if dirty else score(outcomes)
    counts = confusion(dirty or outcomes)
    smallest = smallest_sizes(outcomes, dirty=bool(dirty))
    content = {
        "schema": "irlos-diagnose-suite",
        "schema_version": 2,
        "cases": len(outcomes),
        "failed": dict(failed),
        "numbers": {part: [_row_json(row) for row in rows] for part, rows in parts.items()},
        "confusion": {"truth": HIDDEN, "called": CALLED, "counts": counts},
        "smallest_detectable": smallest,
        "outcomes": [_case_json(one, smallest) for one in outcomes],
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(folder / RESULTS, json_text(content).encode())
    _draw(counts, folder / PICTURE)
    lines = (_table(parts), _untestable(outcomes), _not_right(outcomes))
    return "\n".join([*chain.from_iterable(lines), "", str(folder / RESULTS)])


def _table(parts: Mapping[str, Sequence[Row]]) -> Iterator[str]:
    width = max(len(row.what) for rows in parts.values() for row in rows)
    for part, rows in parts.items():
        yield f"\n{part}"
        yield from (f"  {row.what:<{width}}  {row.aim:<8}  {row.text}".rstrip() for row in rows)


def _untestable(outcomes: Sequence[Outcome]) -> Iterator[str]:
    hidden = Counter(
        (one["truth"]["effects"][0], one["truth"]["setting"])
        for one in outcomes
        if one["truth"]["kind"] in (SINGLE, RAMP_SINGLE) and is_untestable(one)
    )
    if hidden:
        yield f"\nsaid to be untestable ({hidden.total()} cases)"
    yield from (f"  {effect}, {setting}: {count}" for (effect, setting), count in sorted(hidden.items()))


def _not_right(outcomes: Sequence[Outcome]) -> Iterator[str]:
    wrong = [one for one in outcomes if not is_right(one)]
    if wrong:
        yield f"\nnot as hidden ({len(wrong)} cases)"
    for one in wrong:
        yield f"  {one['case']}: {grade(one)}, {gap_text(one)}: {verdict_text(one)}"


def verdict_text(outcome: Outcome) -> str:
    """The verdict in a line: names with what they were not distinguished from, or the reason for none."""
    diagnosis, sets = outcome["diagnosis"], ambiguity_sets(outcome)
    if diagnosis["verdict"] != "effect":
        nearest = (diagnosis.get("nearest") or {}).get("effect")
        why = diagnosis.get("why_unknown", "")
        return f"{diagnosis['verdict']}{f', nearest {nearest}' if nearest else ''}{f': {why}' if why else ''}"
    names = [
        name + (f" ({' or '.join(sorted(alike - {name}))})" if len(alike) > 1 else "")
        for name, alike in zip(named(outcome), sets, strict=True)
    ]
    return ", ".join(names)


def gap_text(outcome: Outcome) -> str:
    """The held-out gap before and after, and its floor."""
    before, after, floor = (outcome["diagnosis"]["gap"].get(key) for key in ("before", "after", "floor"))
    return f"gap {_percent(before)} to {_percent(after)}, floor {_percent(floor)}"


def _percent(part: float | None) -> str:
    return "-" if part is None else f"{part:.2%}"


def _row_json(row: Row) -> dict[str, Any]:
    value = row.value.as_json() if isinstance(row.value, Rate) else {"value": row.value}
    return {"what": row.what.strip(), "aim": row.aim} | value


def _case_json(outcome: Outcome, smallest: Mapping[str, Mapping]) -> dict[str, Any]:
    truth, diagnosis = outcome["truth"], outcome["diagnosis"]
    single, clean = truth["kind"] == SINGLE, not is_dirty(outcome)
    return {
        "case": outcome["case"],
        **truth,
        "verdict": diagnosis["verdict"],
        "grade": grade(outcome),
        "called": called(outcome),
        "named": named(outcome),
        "ambiguity_sets": ambiguity_sets(outcome),
        "right": is_right(outcome),
        "wrong_first_name": None if clean else first_is_wrong(outcome),
        "untestable": is_untestable(outcome),
        "over_smallest": in_smallest(outcome, smallest.get(truth["setting"], {})) if single else None,
        "size_inside": true_size_inside(outcome) if single and clean else None,
        "gap": diagnosis["gap"],
        "ncpa_error_nm": outcome["ncpa_error_nm"],
        "ncpa_bias_nm": outcome["ncpa_bias_nm"],
        "cpu_s": outcome["cpu_s"],
    }
