"""Two runs side by side, as text."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from itertools import groupby
from typing import Any

from irlos_pipe.conventions.text import aligned, printable, rounded_by_error
from irlos_pipe.product.printed import Comparison, ModesPair, NumberPair, ValuePair

SHOWN = 20  # numbers, unless all are asked for
LONGEST = 60
SAME = "the same"
SAME_FILES = "the same; the errors are not independent, and noise makes differences of far less than 1 σ"


def comparison_text(found: Comparison, everything: bool) -> str:
    """Return what differs between two runs.

    Parameters
    ----------
    found : Comparison
        From `compare_runs`.
    everything : bool
        Show all numbers that differ, not only the most significant.
    """
    differ = [one for one in found.numbers if one.difference != 0]
    most = sorted(differ, key=_rank, reverse=True)
    parts = {
        "runs": aligned([("first", found.first), ("second", found.second), *_rows(found.told)]),
        "settings": _table(found.settings),
        "input files": _files_text(found),
        "wavefronts": aligned([_modes_row(one) for one in found.modes]) if found.modes else "",
        f"numbers ({len(differ)} of {len(found.numbers)} differ)": _numbers_text(
            most if everything else most[:SHOWN], len(differ)
        ),
        "words": _table(found.words),
        f"only in {found.first}": _gathered(found.only_first),
        f"only in {found.second}": _gathered(found.only_second),
        "checks": _table(found.checks) or SAME,
    }
    text = "\n\n".join(_titled(title, part) for title, part in parts.items() if part)
    return "\n".join(map(printable, text.split("\n")))


def _rank(one: NumberPair) -> tuple[float, float]:
    """Most significant first; without errors, by the relative difference, behind all others."""
    if math.isfinite(one.sigmas):
        return abs(one.sigmas), 0.0
    size = max(abs(one.first), abs(one.second))
    return -1.0, abs(one.difference) / size if size > 0 else 0.0


def _numbers_text(shown: Sequence[NumberPair], differ: int) -> str:
    if not shown:
        return SAME
    head = ("stage", "number", "first", "second", "difference", "")
    more = [f"… and {differ - len(shown)} more: --all shows them"] if differ > len(shown) else []
    return "\n".join([aligned([head, *map(_number_row, shown)]), *more])


def _number_row(one: NumberPair) -> tuple[str, ...]:
    return (
        one.stage,
        one.name,
        rounded_by_error(one.first, one.first_error, ".6g"),
        rounded_by_error(one.second, one.second_error, ".6g"),
        f"{one.difference:+.3g} {one.unit}".rstrip(),
        f"{one.sigmas:+.1f} σ" if math.isfinite(one.sigmas) else "",
    )


def _modes_row(one: ModesPair) -> tuple[str, ...]:
    return (
        f"{one.stage} {one.name}",
        f"{one.modes} modes",
        f"{one.difference_nm:.1f} nm RMS between them",
        f"{one.expected_nm:.1f} nm RMS from both errors",
    )


def _files_text(found: Comparison) -> str:
    if found.same_files:
        return SAME_FILES
    return "\n".join(f"{one.name}: {_change(one)}" for one in found.files)


def _gathered(names: Sequence[str]) -> str:
    """Names in a line each; entries of one table that go by numbers in one line."""
    lines = []
    for table, group in groupby(names, key=_table_of):
        found = list(group)
        first, last = (found[end].removeprefix(f"{table}.") for end in (0, -1))
        lines += [f"{table}.{first} … {last}"] if table and len(found) > 1 else found
    return "\n".join(lines)


def _table_of(name: str) -> str:
    """The table that an entry that goes by a number belongs to; nothing for any other."""
    table, _, entry = name.rpartition(".")
    return table if entry.isdigit() else ""


def _change(one: ValuePair) -> str:
    return "only in second" if one.first is None else "only in first" if one.second is None else "differs"


def _table(pairs: Sequence[ValuePair]) -> str:
    return aligned(_rows(pairs)) if pairs else ""


def _rows(pairs: Sequence[ValuePair]) -> list[tuple[str, str]]:
    return [(one.name, f"{_shown(one.first)} → {_shown(one.second)}") for one in pairs]


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else "none" if value is None else json.dumps(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 1]}…"


def _titled(title: str, text: str) -> str:
    return f"{title}:\n" + "\n".join(f"  {line}" for line in text.splitlines())
