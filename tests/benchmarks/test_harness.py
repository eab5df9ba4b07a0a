"""What all suites share: runs are gone on with, a bad case ends no other, tables stand between marks."""

from __future__ import annotations

import json
from dataclasses import dataclass

import pytest

from benchmarks.harness import Suite, worked


@dataclass(frozen=True)
class Case:
    name: str
    seed: int = 1

    @property
    def key(self):
        return self.seed, self.name


def outcome_of(case, output):
    if case.name == "bad":
        raise OSError("no space")
    return {"seed": case.seed, "name": case.name, "value": 1 / 3, "long": [0.0] * 9}


def key_of(outcome):
    return outcome["seed"], outcome["name"]


def slim(outcome):
    return {key: value for key, value in outcome.items() if key != "long"}


def report(outcomes, broken, output):
    return f"{len(outcomes)} of {len(outcomes) + len(broken)}"


SUITE = Suite(outcome_of, key_of, report, inside="outcomes", slim=slim)


@pytest.mark.slow
def test_a_case_that_breaks_ends_no_other_and_finished_ones_are_not_repeated(tmp_path):
    cases = [Case("one"), Case("bad"), Case("two")]
    outcomes, broken = worked(SUITE, cases, tmp_path, jobs=1)
    assert [one["name"] for one in outcomes] == ["one", "two"]
    assert broken == {"bad": "OSError: no space"}
    SUITE.path(cases[0], tmp_path).write_text(json.dumps({"seed": 1, "name": "one", "value": "as it was"}))
    assert SUITE.work(cases[0], tmp_path)["value"] == "as it was"


def test_outcomes_of_another_seed_are_not_taken_for_those_asked_for(tmp_path):
    SUITE.work(Case("one"), tmp_path)
    with pytest.raises(ValueError, match="another seed"):
        SUITE.work(Case("one", seed=2), tmp_path)
