"""The table of families, and its place in docs/reliability.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.misled.cases import NIGHT
from benchmarks.misled.working import WRONG_SIGMA
from benchmarks.pages import put

PAGE = Path(__file__).parents[2] / "docs" / "reliability.md"
ACCUSED, WARNED, STATED, PASSED, MISLED = "accused", "warned only", "said before", "passed", "misled"
COLUMNS = ("kind", "family", "cases", ACCUSED, WARNED, STATED, PASSED, MISLED)
ROUTINE = "taken from the"  # what every recording with a plain side-car is warned of


def verdict(outcome: Mapping[str, Any]) -> str:
    """Return the column of an outcome.

    It misleads where nothing is accused and a number is beyond 5 σ, where a diagnosis names what is not
    there, and where it finds nothing although what is hidden is larger than what it says that it can detect.
    A run of a night that passes and is wrong misleads, whatever else the night is accused of.
    """
    misnamed = outcome.get("finding") == "misnamed"
    told = bool(outcome["accused"]) or outcome.get("finding") == "named" or (misnamed and outcome["right"])
    if told and not (_beyond(outcome) and outcome["kind"] == NIGHT):
        return ACCUSED
    if any(ROUTINE not in line for line in outcome["warned"]):
        return WARNED
    missed = outcome.get("finding") == "none" and not outcome["right"]
    if not (_beyond(outcome) or misnamed or missed):
        return PASSED
    cause = outcome["cause"]
    return STATED if cause and any(cause in line for line in outcome["untested"]) else MISLED


def _beyond(outcome: Mapping[str, Any]) -> bool:
    return outcome["sigmas"] is not None and outcome["sigmas"] > WRONG_SIGMA


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
    counts = [found.count(column) for column in COLUMNS[3:]]
    return f"| {kind} | {family} | " + " | ".join(map(str, [len(found), *counts])) + " |"


def summary(outcomes: Sequence[Mapping[str, Any]]) -> str:
    """Return the totals in one line each."""
    lines = []
    for name, right in (("right", True), ("wrong", False)):
        found = [verdict(one) for one in outcomes if one["right"] == right]
        counts = ", ".join(f"{found.count(column)} {column}" for column in COLUMNS[3:])
        lines.append(f"{len(found)} {name} inputs: {counts}.")
    beyond = sum(_beyond(one) for one in outcomes if one["right"] and not one["accused"])
    return "\n".join([*lines, f"{beyond} right inputs that passed have a number beyond {WRONG_SIGMA:g} σ."])


def write_page(text: str) -> None:
    """Put `text` between the marks of docs/reliability.md."""
    put(PAGE, {"misled": text})
