"""Outcomes of the hidden-effect suite that are kept in a file. Truth: outcomes by hand, and their scores."""

from __future__ import annotations

import json

from click.testing import CliRunner

from benchmarks.diagnose_suite.__main__ import main
from benchmarks.diagnose_suite.cases import all_cases
from benchmarks.diagnose_suite.kept import keep, lay_out
from benchmarks.diagnose_suite.scoring import score
from benchmarks.diagnose_suite.working import Folder
from benchmarks.jsonl import read_lines

SEED = 5
CASES = {case.name: case for case in all_cases(SEED)}
CLEAN, SINGLE = CASES["clean.bench_narrow.00"], CASES["single.bench_narrow.companion.strong"]
STEP = {
    "effect": "companion",
    "indistinguishable": [],
    "parameters": {"flux_ratio": 0.0312345678, "sep_mas": 100.0, "pa_deg": 10.0},
    "sigma": {"flux_ratio": 0.001, "sep_mas": 1.0, "pa_deg": 1.0},
    "phrase": "a second source",
}


def outcome(case, seed=SEED, **diagnosis):
    sizes = {"companion": {"flux_ratio": 0.03, "sep_mas": 100.0, "pa_deg": 10.0}} if case is SINGLE else {}
    return {
        "case": case.name,
        "truth": {
            "kind": case.kind,
            "suite_seed": seed,
            "dirty": False,
            "setting": "bench_narrow",
            "level": case.level,
            "effects": list(case.effects),
            "sizes": sizes,
            "known": sizes,
            "mild": {},
        },
        "diagnosis": {
            "verdict": "none",
            "steps": [],
            "untestable": [],
            "mdb": {"companion": {"flux_ratio": 0.001}},
            "gap": {"before": 0.1, "after": 0.05, "floor": 0.05, "shrink": 1.0},
            "seconds": 30.0,
            "tried": ["everything"],
            **diagnosis,
        },
        "ncpa_error_nm": {"before": 6.0, "after": 2.0},
        "ncpa_bias_nm": None,
        "cpu_s": {"simulate": 1.0, "diagnose": 10.0},
    }


OUTCOMES = [outcome(CLEAN), outcome(SINGLE, verdict="effect", steps=[STEP])]


def table(outcomes):
    return [(part, row.what, row.text) for part, rows in score(outcomes).items() for row in rows]


def test_what_is_kept_has_the_same_scores_without_what_none_needs(tmp_path):
    keep(tmp_path / "kept.jsonl", OUTCOMES)
    kept = read_lines(tmp_path / "kept.jsonl")
    assert table(kept) == table(OUTCOMES)
    assert not any(
        {"tried", "phrase"}
        & {*one["diagnosis"], *(key for step in one["diagnosis"]["steps"] for key in step)}
        for one in kept
    )


def test_further_outcomes_stand_beside_those_of_before_and_of_other_seeds(tmp_path):
    file = tmp_path / "kept.jsonl"
    keep(file, OUTCOMES[:1])
    keep(file, [outcome(CLEAN, seed=6)])
    keep(file, OUTCOMES)
    assert sorted((one["truth"]["suite_seed"], one["case"]) for one in read_lines(file)) == [
        (5, CLEAN.name),
        (5, SINGLE.name),
        (6, CLEAN.name),
    ]


def test_only_cases_of_the_seed_are_laid_out_and_none_over_another(tmp_path):
    keep(tmp_path / "kept.jsonl", [*OUTCOMES[:1], outcome(SINGLE, seed=6)])
    folder = Folder(tmp_path / "suite")
    folder.outcome(CLEAN).parent.mkdir(parents=True)
    folder.outcome(CLEAN).write_text("its own")
    lay_out(tmp_path / "kept.jsonl", [CLEAN, SINGLE], folder)
    assert folder.outcome(CLEAN).read_text() == "its own"
    assert not folder.outcome(SINGLE).exists()


def test_a_run_does_not_repeat_what_is_kept(tmp_path):
    keep(tmp_path / "kept.jsonl", OUTCOMES)
    options = ["--kept", str(tmp_path / "kept.jsonl"), "--seed", str(SEED), "--shuffled", "--finished"]
    ran = CliRunner().invoke(main, ["--output", str(tmp_path / "suite"), *options])
    assert ran.exit_code == 0, ran.output
    assert json.loads((tmp_path / "suite/suite.json").read_text())["cases"] == len(OUTCOMES)
    assert not (tmp_path / "suite/data").exists()


def test_random_order_is_that_of_the_seed(tmp_path):
    listed = [
        CliRunner().invoke(main, ["--list", "--shuffled", "--seed", seed]).output.splitlines()
        for seed in ("5", "5", "6")
    ]
    assert listed[0] == listed[1] != listed[2]
    assert sorted(listed[0]) == sorted(listed[2]) == sorted(CASES)
