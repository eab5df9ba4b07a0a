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
from irlos_pipe.paper.common.table import csv_text

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


def counted(outcomes: Sequence[Outcome], right: str, wrong: str) -> list[dict[str, Any]]:
    """Return how often each verdict was given, by kind and `right`, or the key `wrong` of wrong inputs."""
    groups: dict[tuple[str, str], list[str]] = {}
    for one in outcomes:
        family = right if one["right"] else one.get(wrong, wrong)
        groups.setdefault((one["kind"], family), []).append(verdict(one))
    return [
        {"kind": kind, "input": family, "cases": len(found)} | {one: found.count(one) for one in VERDICTS}
        for (kind, family), found in sorted(groups.items())
    ]


def report(outcomes: Sequence[Outcome], *_: Any) -> str:
    """Return the table of kinds, and how many right inputs are far from the truth."""
    rows = counted(outcomes, "right", "wrong")
    table = markdown(list(rows[0]), [list(row.values()) for row in rows], "ll" + "r" * (1 + len(VERDICTS)))
    beyond = sum(_beyond(one) for one in outcomes if one["right"] and not one["accused"])
    return f"{table}\n\n{beyond} right inputs that passed have a number beyond {WRONG_SIGMA:g} σ."


def families(outcomes: Sequence[Outcome]) -> str:
    """Return the table of families, right ones together, as CSV."""
    return csv_text(counted(outcomes, "right", "family"))


SUITE = Suite(outcome_of, itemgetter("suite_seed", "case"), report, "reliability.md", "misled", families)


@click.command()
@harness.options(REPORTED_SEED)
@click.option("--draws", default=3, show_default=True, help="Of every family and setting.")
def main(draws: int, seed: int, **how) -> None:
    """Reduce plausible but wrong inputs, and right ones, and count what is accused and what misleads."""
    harness.run(SUITE, all_cases(seed, draws), **how)
