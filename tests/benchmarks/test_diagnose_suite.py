"""The hidden-effect suite: its cases, its judgement, and two recordings from beginning to end.

Truth: outcomes written down by hand; the sizes that were hidden.
"""

from __future__ import annotations

from dataclasses import replace

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
)
from benchmarks.diagnose_suite.making import plan_case
from benchmarks.diagnose_suite.working import SUITE
from benchmarks.harness import worked
from irlos_pipe.simulate.effects import effects_of
from irlos_pipe.simulate.recordings.files import side_car

CASES = all_cases()
GHOST = {"flux_ratio": 0.003, "sep_mas": 100.0, "pa_deg": 30.0, "defocus_nm": 100.0}
AT_GHOST = {"flux_ratio": 0.003, "sep_mas": 110.0, "pa_deg": 31.0}
APART = {"flux_ratio": 0.01, "sep_mas": 200.0, "pa_deg": 210.0}
COMPANION = {"companion": APART}


def outcome(hidden, *names, kind=SINGLE, verdict=None, found=None, untestable=(), **truth) -> dict:
    """What a case came to: `names` are the names found, each with those it was not distinguished from."""
    steps = [
        {"effect": name, "indistinguishable": others, "parameters": found or {}, "sigma": {}}
        for name, *others in (one.split("|") for one in names)
    ]
    nothing = {"dirty": "mild" in truth, "sizes": {}, "known": {}, "mild": {}}
    return {
        "case": f"{kind}.{hidden}.{'+'.join(names)}",
        "truth": nothing | {"kind": kind, "effects": hidden.split()} | truth,
        "diagnosis": {
            "verdict": verdict or ("effect" if names else "none"),
            "steps": steps,
            "untestable": [*untestable],
            "mdb": {},
        },
    }


def dirty(hidden, *names, **more) -> dict:
    """The same where scale and ghost are a little wrong."""
    return outcome(hidden, *names, **{"mild": {"plate_scale": {"fraction": 0.005}, "ghost": GHOST}} | more)


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
