"""A sample of the damaged and hostile inputs of ``make fuzz``, and checks of the judge that assesses them.

Truth: the result of the same recording without damage, the exit codes of the contract, and entries by hand.
"""

import time
from pathlib import Path

import click
import numpy as np
import pytest
from fuzz import (  # noqa: F401
    fits_kinds,
    judge,
    name_kinds,
    pristine,
    product_kinds,
    transport_kinds,
    tree_kinds,
    yaml_kinds,
)
from fuzz.case import KINDS, Case

SEEDS = range(3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", sorted(KINDS))
def test_damaged_input_causes_at_most_one_line_that_says_what_is_wrong(kind):
    verdicts = [judge.judged(kind, seed) for seed in SEEDS]
    assert [(verdict.seed, verdict.summary, verdict.finding) for verdict in verdicts if verdict.finding] == []


def crash(folder: Path) -> None:
    raise ZeroDivisionError("a bug")


def leave_with_an_unknown_code(folder: Path) -> None:
    raise SystemExit(7)


def write_elsewhere(folder: Path) -> None:
    (folder / "elsewhere").write_text("x")


def change_the_input(folder: Path) -> None:
    (folder / "input").write_text("changed")


def sleep(folder: Path) -> None:
    time.sleep(30)


def take_too_much(folder: Path) -> None:
    np.empty(2 * judge.MEMORY, np.uint8)


def find_bad_data_and_say_nothing(folder: Path) -> None:
    raise SystemExit(3)


DEEDS = {
    crash: "traceback",
    leave_with_an_unknown_code: "exit code 7",
    write_elsewhere: "written outside",
    change_the_input: "written outside",
    sleep: "hang",
    take_too_much: "MemoryError",
    find_bad_data_and_say_nothing: "0 error lines",
}


@pytest.mark.slow
@pytest.mark.parametrize("deed", DEEDS, ids=lambda deed: deed.__name__)
def test_the_judge_sees_a_misdeed(deed, monkeypatch):
    def maker(folder: Path, rng: np.random.Generator) -> Case:
        (folder / "input").write_text("as it was")
        return Case("", (str(folder),))

    parameters = [click.Argument(["folder"])]
    command = click.Command("x", params=parameters, callback=lambda folder: deed(Path(folder)))
    monkeypatch.setitem(KINDS, "recipe", maker)
    monkeypatch.setattr(judge, "cli", command)
    monkeypatch.setattr(judge, "TIME_S", 0.2)
    assert DEEDS[deed] in judge.judged("recipe", 0).finding
