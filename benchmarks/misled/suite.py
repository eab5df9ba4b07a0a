"""What a user learns of each case, counted by family."""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter
from typing import Any

import click

from benchmarks import harness
from benchmarks.harness import Outcome, Suite, markdown
from benchmarks.misled.cases import NIGHT, all_cases
from benchmarks.misled.reducing import outcome_of

REPORTED_SEED = 14142135  # of the reported runs; no limit may rest on its cases, 16180339 is for trials
WRONG_SIGMA = 5.0
ACCUSED, WARNED, STATED, PASSED, MISLED = "accused", "warned only", "said before", "passed", "misled"
VERDICTS = (ACCUSED, WARNED, STATED, PASSED, MISLED)
ROUTINE = "taken from the"  # what every recording with a plain side-car is warned of


def verdict(outcome: Outcome) -> str:
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


def _beyond(outcome: Outcome) -> bool:
    return outcome["sigmas"] is not None and outcome["sigmas"] > WRONG_SIGMA


def table(outcomes: Sequence[Outcome]) -> str:
    """Return the table of families in Markdown, right ones together."""
    groups: dict[tuple[str, bool, str], list[str]] = {}
    for one in outcomes:
        family = "right" if one["right"] else one["family"]
        groups.setdefault((one["kind"], not one["right"], family), []).append(verdict(one))
    rows = [
        [kind, family, len(found), *map(found.count, VERDICTS)]
        for (kind, _, family), found in sorted(groups.items())
    ]
    return markdown(("kind", "family", "cases", *VERDICTS), rows, "ll" + "r" * (1 + len(VERDICTS)))


def summary(outcomes: Sequence[Outcome]) -> str:
    """Return the totals in one line each."""
    lines = []
    for name, right in (("right", True), ("wrong", False)):
        found = [verdict(one) for one in outcomes if one["right"] == right]
        counts = ", ".join(f"{found.count(column)} {column}" for column in VERDICTS)
        lines.append(f"{len(found)} {name} inputs: {counts}.")
    beyond = sum(_beyond(one) for one in outcomes if one["right"] and not one["accused"])
    return "\n".join([*lines, f"{beyond} right inputs that passed have a number beyond {WRONG_SIGMA:g} σ."])


def report(outcomes: Sequence[Outcome], *_: Any) -> str:
    """Return table and totals."""
    return f"{table(outcomes)}\n\n{summary(outcomes)}"


SUITE = Suite(outcome_of, itemgetter("suite_seed", "case"), report, "reliability.md", "misled")


@click.command()
@harness.options(REPORTED_SEED)
@click.option("--draws", default=3, show_default=True, help="Of every family and setting.")
def main(draws: int, seed: int, **how) -> None:
    """Reduce plausible but wrong inputs, and right ones, and count what is accused and what misleads."""
    harness.run(SUITE, all_cases(seed, draws), **how)
