"""The hidden-effect suite: its cases, its judgement and its scores, and two recordings from beginning to end.

Truth: outcomes made by hand, whose scores can be counted; the sizes of the errors as the suite states them;
images whose moments are known.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.diagnose_suite.cases import (
    CLEAN,
    OUTSIDE,
    PAIR,
    RAMP_SINGLE,
    SINGLE,
    Case,
    Setting,
    all_cases,
)
from benchmarks.diagnose_suite.judging import (
    extra_names,
    first_is_wrong,
    is_first,
    is_in_set,
    is_in_some_set,
    is_named,
    is_right,
    is_untestable,
    true_size_inside,
)
from benchmarks.diagnose_suite.making import plan_case
from benchmarks.diagnose_suite.scoring import score, write_report
from benchmarks.diagnose_suite.working import SUITE
from benchmarks.harness import keep, read_lines, worked
from irlos_pipe.simulate.effects import effects_of
from irlos_pipe.simulate.recordings.files import side_car

CASES = all_cases()
GHOST = {"flux_ratio": 0.003, "sep_mas": 100.0, "pa_deg": 30.0, "defocus_nm": 100.0}
AT_GHOST = {"flux_ratio": 0.003, "sep_mas": 110.0, "pa_deg": 31.0}
APART = {"flux_ratio": 0.01, "sep_mas": 200.0, "pa_deg": 210.0}
COMPANION = {"companion": APART}


def outcome(hidden, *names, kind=SINGLE, verdict=None, sizes=None, found=None, sigma=None, **more) -> dict:
    """What a case came to: `names` are the names found, each with those it was not distinguished from."""
    hidden = hidden.split()
    steps = [
        {"effect": name, "indistinguishable": others, "parameters": found or {}, "sigma": sigma or {}}
        for name, *others in (one.split("|") for one in names)
    ]
    keys = ("mdb", "untestable", "unexplained", "grade")
    diagnosis = {"untestable": [], "mdb": {}} | {key: more[key] for key in keys if key in more}
    return {
        "case": f"{kind}.{'+'.join(hidden)}.{'+'.join(names)}",
        "truth": {
            "kind": kind,
            "suite_seed": 0,
            "dirty": "mild" in more,
            "setting": "bench_narrow",
            "level": "weak",
            "effects": hidden,
            "sizes": {hidden[0]: sizes} if sizes else {},
            "known": more.get("known", {}),
            "mild": more.get("mild", {}),
        },
        "diagnosis": {
            "verdict": verdict or ("effect" if names else "none"),
            "steps": steps,
            "gap": {"before": 0.04, "after": 0.02, "floor": 0.01, "shrink": more.get("shrink")},
            "seconds": 30.0,
            **diagnosis,
        },
        "ncpa_error_nm": more.get("errors", {"before": 1.0, "after": 1.0}),
        "ncpa_bias_nm": more.get("biases"),
        "cpu_s": {"simulate": 1.0, "diagnose": 20.0},
    }


def dirty(hidden, *names, **more) -> dict:
    """The same where scale and ghost are a little wrong."""
    return outcome(hidden, *names, **{"mild": {"plate_scale": {"fraction": 0.005}, "ghost": GHOST}} | more)


def values(parts, part) -> dict:
    return {row.what.strip(): row.value for row in parts[part]}


# -- the cases ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "case", [c for c in CASES if c.kind in (SINGLE, PAIR, RAMP_SINGLE)][::23], ids=lambda c: c.name
)
def test_every_hidden_effect_is_a_valid_simulation_and_its_side_car_that_of_none(case, tmp_path):
    plan = plan_case(case, tmp_path / "spec.yaml")
    assert [one.effect for one in plan.hidden] == list(case.effects)
    effects_of({one.effect: one.parameters for one in plan.hidden})
    told = side_car(plan.recordings[-1])
    assert told["pixel_scale_mas"] == 9.7 and told["diversity"]["zernike"] == {6: -170.0}
    assert "effects" not in told


# -- effects outside the catalogue -------------------------------------------------------------


# -- mild errors of everything -----------------------------------------------------------------


# -- judging -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("one", "true", "false"),
    [
        (outcome("companion", "companion"), [is_first, is_in_set, is_right], [extra_names]),
        (outcome("companion", "vibration"), [extra_names], [is_first, is_right]),
        (outcome("companion", "vibration|companion|phase_bump"), [is_in_set], [is_first]),
        (outcome("companion", "vibration|companion|phase_bump|spectrum"), [], [is_in_set]),
        (outcome("companion", "vibration", "companion"), [is_named], [is_in_set, is_right]),
        (outcome("companion", verdict="unknown"), [], [is_in_set]),
        (outcome("companion", "companion", "vibration"), [is_first, extra_names], [is_right]),
        (dirty("companion", "companion_2", known=COMPANION, found=APART), [is_first], [first_is_wrong]),
        # a mild error that is there is no wrong name
        (dirty("vibration", "plate_scale", "vibration"), [is_named, is_right], [is_first, first_is_wrong]),
        (dirty("vibration", "phase_bump", "vibration"), [is_named, first_is_wrong], [is_right]),
        (dirty("plate_scale", "spectrum|plate_scale"), [is_in_some_set], [is_named, first_is_wrong]),
        # a second image is right where the ghost is, and a hidden one is not named by the ghost
        (dirty("vibration", "companion", found=AT_GHOST), [], [first_is_wrong]),
        (dirty("vibration", "ghost", found=APART), [first_is_wrong], []),
        (dirty("companion", "companion", known=COMPANION, found=AT_GHOST), [], [is_named, first_is_wrong]),
        (dirty("ghost", "companion", mild={}, known={"ghost": GHOST}, found=GHOST), [], [is_named]),
        (dirty("ghost", "companion", mild={}, known={"ghost": GHOST}, found=GHOST), [], [first_is_wrong]),
        (dirty("", kind=CLEAN, verdict="unknown"), [is_right], []),
        (dirty("", "plate_scale", kind=CLEAN), [is_right], []),
        (dirty("scratch", "phase_bump", kind=OUTSIDE), [], [is_right]),
        (dirty("vibration", "plate_scale", kind=PAIR), [], [is_right]),
        # what the data cannot show is untestable beside right names only
        (dirty("diversity_error", "plate_scale", untestable=["diversity_error"]), [is_untestable], []),
        (dirty("diversity_error", "phase_bump", untestable=["diversity_error"]), [], [is_untestable]),
    ],
    ids=lambda one: one["case"] if isinstance(one, dict) else "",
)  # fmt: skip
def test_a_diagnosis_is_judged_by_what_it_names_and_where(one, true, false):
    assert all(judge(one) for judge in true)
    assert not any(judge(one) for judge in false)


@pytest.mark.parametrize(
    ("effect", "true", "found", "sigma", "inside"),
    [
        ("companion", {"nm": 50.0}, {"nm": 51.9, "sep_mas": 9.0}, {"nm": 1.0}, True),
        ("companion", {"nm": 50.0}, {"nm": 52.1}, {"nm": 1.0}, False),
        # of petals the common piston is no size; a mode that is missing among those found is not inside
        ("low_wind_effect", {"tip_nm": [1.0, -1.0]}, {"tip_nm": [101.0, 99.0]}, {"tip_nm": [1.0, 1.0]}, True),
        ("ncpa_drift", {"nm": {"4": 20.0, "7": 9.0}}, {"nm": {"4": 20.0}}, {"nm": {"4": 1.0}}, False),
    ],
)  # fmt: skip
def test_a_size_is_inside_its_interval_up_to_two_standard_errors(effect, true, found, sigma, inside):
    assert true_size_inside(outcome(effect, effect, sizes=true, found=found, sigma=sigma)) is inside


# -- scores ------------------------------------------------------------------------------------


def found_with(effect, shrink, errors, biases):
    of_both = [dict(zip(("before", "after"), pair, strict=True)) for pair in (errors, biases)]
    size = {"size": 1.0}
    return outcome(
        effect, effect, sizes=size, found={"size": 1.1}, sigma={"size": 0.1},
        shrink=shrink, errors=of_both[0], biases=of_both[1],
    )  # fmt: skip


@pytest.mark.slow
def test_the_table_counts_what_was_made_by_hand(tmp_path):
    outcomes = [
        outcome("", kind=CLEAN),
        outcome("", kind=CLEAN),
        outcome("", "companion", kind=CLEAN),
        found_with("companion", 0.95, (10.0, 8.5), (6.0, 2.9)),
        found_with("vibration", 0.85, (10.0, 4.9), (9.0, 3.0)),
        outcome("phase_bump", "high_order_ncpa|phase_bump"),
        outcome("spectrum", verdict="unknown"),
        outcome("diversity_error", untestable=["diversity_error"], sizes={"nm": 9.0}),
        outcome("companion vibration", "companion", "vibration", kind=PAIR),
        outcome("companion vibration", "companion", kind=PAIR),
        outcome("scratch", kind=OUTSIDE, verdict="unknown"),
        outcome("scratch", "phase_bump", kind=OUTSIDE),
    ]
    parts = score(outcomes)
    alarms, one = values(parts, "clean")["something called missing"], values(parts, "one effect")
    assert (alarms.count, alarms.total) == (1, 3)
    assert (one["named first"].count, one["named first, or in a set of <= 3"].count) == (2, 3)
    assert (one["named first"].total, one["mean size of the first set"]) == (4, pytest.approx(4 / 3))
    other, models = values(parts, "other"), values(parts, "model with what was found")
    assert other["pairs: both named"].value == other["outside the catalogue: unknown"].value == 0.5
    assert other["outside the catalogue: a confident wrong name"].count == 1
    assert models["held-out gap: median shrink"] == pytest.approx(0.9)
    assert (models["NCPA error halved where biased > 5 nm"].count, models["the bias alone halved"].count) == (
        1,
        2,
    )
    text = write_report(outcomes, {"clean.bench_narrow.00": "OSError: no space"}, tmp_path)
    assert "diversity_error, bench_narrow: 1" in text
    reported = json.loads((tmp_path / "suite.json").read_text())
    assert reported["failed"] == {"clean.bench_narrow.00": "OSError: no space"}
    assert (tmp_path / "confusion.png").read_bytes().startswith(b"\x89PNG")
    matrix = reported["confusion"]
    cells = {(matrix["truth"][i], matrix["called"][j]) for i, j in np.argwhere(matrix["counts"])}
    assert {("(nothing)", "none"), ("phase_bump", "high_order_ncpa"), ("(outside)", "unknown")} < cells
    assert ("diversity_error", "(untestable)") in cells and np.sum(matrix["counts"]) == len(outcomes) - 2
    keep(SUITE, tmp_path / "kept.jsonl", outcomes)
    kept = score(read_lines(tmp_path / "kept.jsonl"))
    assert [row.text for rows in kept.values() for row in rows] == [
        row.text
        for rows in score({SUITE.key(one): one for one in outcomes}.values()).values()
        for row in rows
    ]


# -- from beginning to end ---------------------------------------------------------------------


@pytest.mark.long
def test_a_companion_and_an_offset_of_the_focus_stage_are_found_with_their_sizes(tmp_path):
    small = Setting("bench", "narrow_h", 8.0, frames=32, window=40)
    cases = [
        Case(SINGLE, small, ("companion",), "strong"),
        Case(RAMP_SINGLE, small, ("focus_stage_offset",), "strong"),
    ]
    outcomes, failed = worked(SUITE, cases, tmp_path, jobs=1)
    assert failed == {} and all(is_right(one) for one in outcomes)
    companion = outcomes[0]
    truth, (step,) = companion["truth"]["sizes"]["companion"], companion["diagnosis"]["steps"]
    assert step["parameters"]["flux_ratio"] == pytest.approx(truth["flux_ratio"], rel=0.03)
    assert companion["ncpa_error_nm"]["after"] < 0.5 * companion["ncpa_error_nm"]["before"]
    assert companion["ncpa_bias_nm"]["after"] < 0.2 * companion["ncpa_bias_nm"]["before"]
    given = [path.read_bytes() for path in (tmp_path / "data").rglob("*") if path.is_file()]
    assert given
    assert not any(b"flux_ratio" in content or b"focus_stage" in content for content in given)
    with pytest.raises(ValueError, match="another seed"):
        SUITE.work(replace(cases[0], suite_seed=5), tmp_path)
