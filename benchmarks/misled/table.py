"""The table of families, and its place in docs/reliability.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.misled.working import WRONG_SIGMA

PAGE = Path(__file__).parents[2] / "docs" / "reliability.md"
BEGIN, END = "<!-- misled: begin -->", "<!-- misled: end -->"
COLUMNS = ("kind", "family", "cases", "accused", "warned only", "passed", "passed, > 5 σ wrong")
ROUTINE = "taken from the"  # what every recording with a plain side-car is warned of
# What no cube can tell of itself, see "Not tested by these data".
INHERENT = (
    "diversity of wrong sign",
    "diversity 15 % off",
    "diversity of Noll 5",
    "turned by 180°",
    "transposed",
    "wavelength and scale 10 % off",
)


def verdict(outcome: Mapping[str, Any]) -> str:
    """`accused`, `warned`, `passed`, or `misled`: passed without a word, and beyond 5 σ."""
    if outcome["accused"]:
        return "accused"
    if any(ROUTINE not in line for line in outcome["warned"]):
        return "warned"
    wrong = outcome["sigmas"] is not None and outcome["sigmas"] > WRONG_SIGMA
    silent = outcome.get("verdict") == "none" and not outcome["right"]
    return "misled" if wrong or silent else "passed"


def table(outcomes: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of families in Markdown, right ones together."""
    groups: dict[tuple[str, str], list[str]] = {}
    for one in outcomes:
        family = "right" if one["right"] else one["family"]
        groups.setdefault((one["kind"], family), []).append(verdict(one))
    rows = [_row(*key, found) for key, found in sorted(groups.items(), key=lambda item: _order(item[0]))]
    lines = ["| " + " | ".join(COLUMNS) + " |", "|---|---|" + "---:|" * (len(COLUMNS) - 2)]
    return "\n".join([*lines, *rows])


def _order(key: tuple[str, str]) -> tuple[str, bool, str]:
    return key[0], key[1] != "right", key[1]


def _row(kind: str, family: str, found: list[str]) -> str:
    mark = " ¹" if family in INHERENT and kind == "calibration" else ""
    counts = [found.count("accused"), found.count("warned"), found.count("passed"), found.count("misled")]
    return f"| {kind} | {family}{mark} | " + " | ".join(map(str, [len(found), *counts])) + " |"


def summary(outcomes: Sequence[Mapping[str, Any]]) -> str:
    """Return the totals in one line each."""
    right = [verdict(one) for one in outcomes if one["right"]]
    wrong = [(one, verdict(one)) for one in outcomes if not one["right"]]
    inherent = [one for one, what in wrong if what == "misled" and one["family"] in INHERENT]
    misled = sum(what == "misled" for _, what in wrong)
    return (
        f"{len(right)} right inputs: {right.count('accused')} accused, {right.count('warned')} warned of, "
        f"{right.count('misled')} beyond {WRONG_SIGMA:g} σ.\n"
        f"{len(wrong)} wrong inputs: {sum(what == 'accused' for _, what in wrong)} accused, "
        f"{sum(what == 'warned' for _, what in wrong)} warned of, {misled} passed though beyond "
        f"{WRONG_SIGMA:g} σ or with nothing found, {len(inherent)} of them of families that no cube can tell."
    )


def write_page(text: str) -> None:
    """Put `text` between the marks of docs/reliability.md."""
    page = PAGE.read_text()
    begin, end = page.index(BEGIN) + len(BEGIN), page.index(END)
    PAGE.write_text(f"{page[:begin]}\n{text}\n{page[end:]}")
