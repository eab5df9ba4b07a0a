"""Each mistake is made, reduced as a user does, and the causes that are named are counted."""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks import harness
from benchmarks.harness import Outcome, Rate, Suite, file_name, markdown
from benchmarks.misled.reducing import mode_errors
from benchmarks.mistakes.making import MISTAKES, SCALES_MAS, UNDECIDABLE, made
from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.recipe import load_recipe

REPORTED_SEED, TRIAL_SEED = 26535897, 57721566  # nothing may rest on the cases of the former
WRONG_SIGMA = 5.0


@dataclass(frozen=True)
class Case:
    """One cube with a mistake."""

    telescope: str
    mistake: str
    draw: int
    suite_seed: int

    @property
    def name(self) -> str:
        return f"{file_name(self.mistake)}.{self.telescope}.{self.draw}"

    @property
    def key(self) -> tuple:
        return self.suite_seed, self.name


def all_cases(seed: int, draws: int) -> list[Case]:
    return [Case(t, m, draw, seed) for draw in range(draws) for m in MISTAKES for t in SCALES_MAS]


def outcome_of(case: Case, *_) -> Outcome:
    """Make, reduce and judge a case."""
    kinds = list(MISTAKES).index(case.mistake), list(SCALES_MAS).index(case.telescope)
    seed = (case.suite_seed, *kinds, case.draw)
    true, taken = MISTAKES[case.mistake]
    outcome = {"suite_seed": case.suite_seed, "case": case.name, "mistake": case.mistake, "true": list(true)}
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        settings, ncpa_nm = made(case.telescope, taken(np.random.default_rng(seed)), seed, scratch)
        began = time.process_time()
        try:
            found = _reduced(scratch, settings, ncpa_nm)
        except IrlosError as problem:
            found = {"failed": ["refused"], "why": str(problem), "causes": [], "sigmas": None}
    return outcome | found | {"cpu_s": round(time.process_time() - began, 2)}


def _reduced(scratch: Path, settings: Sequence[str], ncpa_nm: dict[int, float]) -> dict[str, Any]:
    recipe = load_recipe("ncpa_calibration", settings, [f"calibration={scratch / 'cube.fits'}"], seed=1)
    products, failed = harness.reduced(recipe, scratch, logging.Logger("mistakes"))
    results = products["calibrate"].results
    errors = mode_errors(results["zernike_nm"], results["sigma_nm"], ncpa_nm)
    return {
        "failed": [check.name for check in failed],
        "why": "; ".join(check.message for check in failed),
        "causes": [
            {key: one.get(key) for key in ("name", "says", "explains")} for one in results.get("causes", [])
        ],
        "untested": results.get("untested", []),
        **{key: errors[key] for key in ("sigmas", "error_nm")},
        "seconds": results["seconds"],
    }


def named(outcome: Outcome, most: int) -> bool:
    """Whether one of the first causes is the true one; a refusal names it in its message."""
    if outcome["failed"] == ["refused"]:
        return any(word[:6] in outcome["why"] for word in outcome["true"])
    return any(one["name"] in outcome["true"] for one in outcome["causes"][:most])


def looks_right(outcome: Outcome) -> bool:
    """Whether nothing is said of a wrong result."""
    return not outcome["failed"] and outcome["sigmas"] > WRONG_SIGMA


def said_before(outcome: Outcome) -> bool:
    """Whether the report says before its numbers that such images cannot tell this mistake."""
    word = UNDECIDABLE.get(outcome["mistake"])
    return word is not None and any(word in line for line in outcome["untested"])


def report(outcomes: Sequence[Outcome], *_: Any) -> str:
    """Return the table of mistakes, those that are always named first in one row, and the rates of all."""
    rows, always = [], []
    for mistake in MISTAKES:
        group = [one for one in outcomes if one["mistake"] == mistake]
        noticed = [one for one in group if one["failed"]]
        first, three = (sum(named(one, most) for one in noticed) for most in (1, 3))
        silent = [said_before(one) for one in group if looks_right(one)]
        harmless = len(group) - len(noticed) - len(silent)
        counts = len(group), len(noticed), first, three, sum(silent), len(silent) - sum(silent), harmless
        (always if len(group) == first else rows).append((mistake, *counts))
    head = (
        "mistake", "cubes", "noticed", "named first", "among three", "wrong, said before",
        "wrong without a word", "harmless",
    )  # fmt: skip
    if always:
        names, *columns = zip(*always, strict=True)
        rows.append((", ".join(names), *map(sum, columns)))
    noticed = [one for one in outcomes if one["failed"] and one["true"]]
    rates = [Rate.of(named(one, most) for one in noticed).text for most in (1, 3)]
    words = f"is named first in {rates[0]}, among the first three in {rates[1]}."
    return f"{markdown(head, rows, 'lrrrrrrr')}\n\nOf the mistakes that were noticed the true cause {words}"


SUITE = Suite(outcome_of, itemgetter("suite_seed", "case"), report, "reliability.md", "mistakes")


@click.command()
@harness.options(REPORTED_SEED)
@click.option("--draws", default=3, show_default=True, help="Of every mistake and telescope.")
def main(draws: int, seed: int, **how) -> None:
    """Make every mistake on purpose, and count whether its true cause is named."""
    harness.run(SUITE, all_cases(seed, draws), **how)
