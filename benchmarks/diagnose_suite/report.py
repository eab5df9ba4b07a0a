"""What the suite reports: a table for people, `suite.json` and `confusion.png` for everything else."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from benchmarks.diagnose_suite.cases import RAMP_SINGLE, SINGLE
from benchmarks.diagnose_suite.confusion import Confusion, called, draw_confusion
from benchmarks.diagnose_suite.groups import in_world, smallest_sizes
from benchmarks.diagnose_suite.judging import (
    Outcome,
    ambiguity_sets,
    first_is_wrong,
    grade,
    is_dirty,
    is_right,
    is_untestable,
    named,
)
from benchmarks.diagnose_suite.rates import Rate
from benchmarks.diagnose_suite.scoring import Row, score
from benchmarks.diagnose_suite.scoring_dirty import score_dirty
from benchmarks.diagnose_suite.sizes import in_smallest, true_size_inside
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text

RESULTS, PICTURE = "suite.json", "confusion.png"


def write_report(outcomes: Sequence[Outcome], failed: Mapping[str, str], folder: Path) -> str:
    """Write both files into a folder; returns the table.

    Parameters
    ----------
    failed : mapping of str to str
        What stopped the cases that have no outcome, by name.
    """
    dirty = in_world(outcomes, dirty=True)
    parts = score_dirty(outcomes) if dirty else score(outcomes)
    confusion = Confusion.of(dirty or outcomes)
    smallest = smallest_sizes(outcomes, dirty=bool(dirty))
    content = {
        "schema": "irlos-diagnose-suite",
        "schema_version": 2,
        "cases": len(outcomes),
        "failed": dict(failed),
        "numbers": {part: [_row_json(row) for row in rows] for part, rows in parts.items()},
        "confusion": confusion.as_json(),
        "smallest_detectable": smallest,
        "outcomes": [_case_json(one, smallest) for one in outcomes],
    }
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(folder / RESULTS, json_text(content).encode())
    draw_confusion(confusion, folder / PICTURE)
    lines = (_table(parts), _untestable(outcomes), _not_right(outcomes), _broken(failed))
    return "\n".join([*chain.from_iterable(lines), "", str(folder / RESULTS)])


# -- for people --------------------------------------------------------------------------------


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


def _broken(failed: Mapping[str, str]) -> Iterator[str]:
    if failed:
        yield f"\nstopped by an error ({len(failed)} cases)"
    yield from (f"  {name}: {problem}" for name, problem in failed.items())


# -- for scripts -------------------------------------------------------------------------------


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
