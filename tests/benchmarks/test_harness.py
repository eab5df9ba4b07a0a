"""What all suites share: runs are gone on with, a bad case ends no other, tables stand between marks."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks import pulls, random_instrument
from benchmarks.diagnose_suite import working as diagnose_suite
from benchmarks.focus_faults import suite as focus_faults
from benchmarks.harness import Rate, Suite, chosen, keep, lay_out, markdown, put, read_lines, worked
from benchmarks.misled import suite as misled
from benchmarks.mistakes import suite as mistakes


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


def test_what_is_kept_stands_beside_that_of_other_seeds_and_is_laid_out_over_nothing(tmp_path):
    file, folder = tmp_path / "kept.jsonl", tmp_path / "suite"
    keep(SUITE, file, [outcome_of(Case("one"), folder)])
    keep(SUITE, file, [outcome_of(Case("one", seed=2), folder), outcome_of(Case("two", seed=2), folder)])
    assert [key_of(one) for one in read_lines(file)] == [(1, "one"), (2, "one"), (2, "two")]
    assert read_lines(file)[0] == {"seed": 1, "name": "one", "value": 0.333333}
    own = SUITE.path(Case("one", seed=2), folder)
    own.parent.mkdir(parents=True)
    own.write_text("its own")
    lay_out(SUITE, file, [Case("one", seed=2), Case("two", seed=2), Case("three", seed=2)], folder)
    assert own.read_text() == "its own"
    assert {path.stem for path in own.parent.iterdir()} == {"one", "two"}


def test_a_sample_is_spread_over_the_cases_whose_name_matches():
    cases = [Case(f"{kind}.{number}") for kind in "ab" for number in range(10)]
    assert [case.name for case in chosen(cases, "b.*", 3)] == ["b.0", "b.4", "b.9"]


def test_rates_have_the_intervals_of_clopper_and_pearson():
    """Without an event the upper limit is 1 - (α/2)^(1/n)."""
    rate = Rate.of([False] * 48)
    assert (rate.count, rate.total, rate.low) == (0, 48, 0.0)
    assert rate.high == pytest.approx(1 - 0.025 ** (1 / 48))
    assert np.isnan(Rate.of([]).value)


def test_tables_stand_between_their_marks_and_a_page_without_them_is_named(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- pulls -->\nold\n<!-- /pulls -->\nafter\n")
    put(page, {"pulls": markdown(["a", "b"], [[1, "x"]], "rl")})
    table = "| a | b |\n|---:|---|\n| 1 | x |"
    assert page.read_text() == f"before\n<!-- pulls -->\n\n{table}\n\n<!-- /pulls -->\nafter\n"
    with pytest.raises(SystemExit, match=r"page\.md: no place for the table"):
        put(page, {"table": ""})


@pytest.mark.parametrize("suite", [diagnose_suite, misled, mistakes, random_instrument, pulls, focus_faults])
def test_names_of_cases_are_their_own_and_can_be_listed_without_a_folder(suite):
    listed = CliRunner().invoke(suite.main, ["--list"])
    names = listed.output.splitlines()
    assert listed.exit_code == 0
    assert len(set(names)) == len(names) >= 200
    assert not any("/" in name for name in names)


def test_a_run_needs_a_folder_and_something_to_do(tmp_path):
    for options in (
        [],
        ["--output", str(tmp_path), "--finished"],
        ["--output", str(tmp_path), "--only", "x"],
    ):
        assert CliRunner().invoke(misled.main, options).exit_code == 2
