"""The hidden-effect suite where everything has a mild error beside what is hidden.

Truth: the sizes of the errors as the suite states them; outcomes made by hand, whose scores can be counted.
"""

from __future__ import annotations

import json
from itertools import groupby

import numpy as np
import pytest

from benchmarks.diagnose_suite.__main__ import chosen
from benchmarks.diagnose_suite.cases import CLEAN, OUTSIDE, PAIR, SINGLE, Case, all_cases
from benchmarks.diagnose_suite.groups import smallest_sizes, sorted_singles
from benchmarks.diagnose_suite.judging import (
    first_is_wrong,
    grade,
    is_first,
    is_in_some_set,
    is_named,
    is_right,
    is_untestable,
    wrong_names,
)
from benchmarks.diagnose_suite.mild import LAWS, drawn_mild
from benchmarks.diagnose_suite.planning import plan_case
from benchmarks.diagnose_suite.report import write_report
from benchmarks.diagnose_suite.scoring_dirty import score_dirty
from benchmarks.diagnose_suite.settings import SETTINGS
from benchmarks.diagnose_suite.working import Folder, work
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.simulate.recordings.files import side_car

DIRTY = [case for case in all_cases(dirty=True) if case.dirty]
GHOST = {"flux_ratio": 0.003, "sep_mas": 100.0, "pa_deg": 30.0, "defocus_nm": 100.0}


def dirty(name: str) -> Case:
    (case,) = chosen(DIRTY, f"dirty.{name}")
    return case


def planned(name: str, tmp_path):
    return plan_case(dirty(name), tmp_path / "spec.yaml")


def outcome(effect, *names, kind=SINGLE, verdict="effect", known=None, parameters=None, **reported) -> dict:
    """What a case came to; `parameters` are those of every name."""
    truth = {
        "kind": kind,
        "suite_seed": 0,
        "dirty": True,
        "setting": "bench_narrow",
        "level": "weak",
        "effects": [effect] if effect else [],
        "sizes": {},
        "known": known or {},
        "mild": {"plate_scale": {"fraction": 0.005}, "ghost": GHOST},
    }
    steps = [
        {"effect": name, "indistinguishable": [], "parameters": parameters or {}, "sigma": {}}
        for name in names
    ]
    diagnosis = {
        "verdict": verdict,
        "steps": steps,
        "untestable": [],
        "mdb": {},
        "gap": {"before": 0.04, "after": 0.02, "floor": 0.01, "shrink": 0.67},
        "seconds": 30.0,
    }
    return {
        "case": f"dirty.{kind}.{effect}.{'+'.join(names)}",
        "truth": truth,
        "diagnosis": diagnosis | reported,
        "ncpa_error_nm": {"before": 9.0, "after": 4.0},
        "ncpa_bias_nm": None,
        "cpu_s": {"simulate": 1.0, "diagnose": 20.0},
    }


def test_a_second_one_of_its_kind_is_one_of_its_kind():
    """The label in a diagnosis says which of several it is."""
    place = {"flux_ratio": 0.01, "sep_mas": 250.0, "pa_deg": 10.0}
    one = outcome("companion", "companion_2", known={"companion": place}, parameters=place)
    assert is_first(one) and not first_is_wrong(one)


# -- the cases ---------------------------------------------------------------------------------


def test_every_case_has_a_dirty_one_and_clean_cubes_say_what_is_detectable():
    names = {case.name for case in all_cases()}
    assert {case.name for case in DIRTY} == {f"dirty.{name}" for name in names}
    reference = [case for case in all_cases(dirty=True) if not case.dirty]
    assert {case.kind for case in reference} == {"clean", "ramp_clean"}
    assert {case.name for case in reference} < names


def test_another_suite_seed_gives_every_case_another_draw():
    first, second = ([case.seed for case in all_cases(seed, dirty=True)] for seed in (0, 1))
    assert len({*first, *second}) == 2 * len(first)


@pytest.mark.parametrize("setting", SETTINGS.values(), ids=lambda one: one.name)
def test_everything_is_wrong_by_the_stated_size_and_in_either_direction(setting):
    facility = load_instrument("irlos").facility
    drawn = [drawn_mild(setting, np.random.default_rng(seed)) for seed in range(40)]
    effects = [one.effects for one in drawn]
    centre_nm = {"narrow_h": 1600.0, "j_h": (1215.0 + 1625.0) / 2}[setting.bands]
    stop_m = [
        np.hypot(one["pupil_misregistration"]["dx_m"], one["pupil_misregistration"]["dy_m"])
        for one in effects
    ]
    signed = {
        3.0: [one["pupil_misregistration"]["rotation_deg"] for one in effects],
        0.005: [one["plate_scale"]["fraction"] for one in effects],
        5.0: [one["spectrum"]["wavelength_nm"] - centre_nm for one in effects],
        0.1: [one.sections["pupil"]["obscuration_m"] / facility.pupil.obscuration_m - 1 for one in drawn],
    }
    assert stop_m == pytest.approx([0.05] * 40)
    for size, values in signed.items():
        assert np.abs(values) == pytest.approx(size) and set(np.sign(values)) == {-1.0, 1.0}
    assert all(one["ghost"]["flux_ratio"] == 0.003 for one in effects)
    assert all(one.sections["ncpa"] == {"tail_nm": 2.0, "tail_nolls": [52, 200]} for one in drawn)
    assert all(one.sections["detector"]["flat_error_rms"] == 0.005 for one in drawn)


def test_on_sky_every_other_law_of_the_residual_occurs_and_on_the_bench_none():
    sky, bench = (
        [drawn_mild(SETTINGS[name], np.random.default_rng(seed)).sections.get("sky") for seed in range(40)]
        for name in ("sky_narrow", "bench_narrow")
    )
    assert {one["shape"] for one in sky} == {law["shape"] for law in LAWS}
    assert set(bench) == {None}


def test_the_side_car_is_that_of_a_nominal_instrument(tmp_path):
    name = "single.sky_broad.companion.medium"
    with_errors = planned(name, tmp_path).recordings
    (case,) = chosen(all_cases(), name)
    without = plan_case(case, tmp_path / "spec.yaml").recordings
    told = [[set(side_car(one)) for one in each] for each in (with_errors, without)]
    assert told[0] == told[1]
    (stated,), (nominal,) = ([side_car(one) for one in each] for each in (with_errors, without))
    drawn = ("seeing_arcsec",)  # by the case's seed
    assert {k: v for k, v in stated.items() if k not in drawn} == {
        k: v for k, v in nominal.items() if k not in drawn
    }


def test_the_simulated_telescope_has_the_errors(tmp_path):
    plan = planned("single.sky_narrow.companion.medium", tmp_path)
    scene = plan.recordings[0].scene
    assert scene.geometry.obscuration_m == plan.mild.sections["pupil"]["obscuration_m"]
    assert {"plate_scale", "spectrum", "pupil_misregistration", "ghost", "companion"} == set(scene.effects)
    assert max(scene.ncpa_nm) == 200
    assert scene.detector.flat_error_rms == 0.005
    law = plan.mild.sections["sky"]
    assert {"shape": scene.sky.shape, "outer_scale_m": scene.facility.outer_scale_m}.items() <= law.items()


def test_in_a_narrow_band_nothing_scales_the_image_beside_a_hidden_scale(tmp_path):
    narrow, broad = (
        planned(f"single.bench_{band}.plate_scale.medium", tmp_path).recordings[0].scene.effects
        for band in ("narrow", "broad")
    )
    assert "spectrum" not in narrow and "spectrum" in broad


@pytest.mark.parametrize(
    ("effect", "key"),
    [("plate_scale", "fraction"), ("pupil_misregistration", "dx_m"), ("ghost", "flux_ratio")],
)
def test_what_is_hidden_takes_the_place_of_the_mild_error_of_its_kind(effect, key, tmp_path):
    plan = planned(f"single.bench_narrow.{effect}.strong", tmp_path)
    (hidden,) = plan.hidden
    assert plan.recordings[0].scene.effects[effect][key] == hidden.parameters[key]
    assert effect not in plan.mild.truth


def test_the_colour_of_the_star_is_hidden_beside_a_displaced_band(tmp_path):
    plan = planned("single.bench_broad.spectrum.strong", tmp_path)
    spectrum = plan.recordings[0].scene.effects["spectrum"]
    assert abs(spectrum["wavelength_nm"] - 1420.0) == pytest.approx(5.0)
    assert spectrum["slope"] == plan.hidden[0].parameters["slope"]


def test_the_calibration_of_a_ramp_has_the_same_errors_as_the_ramp(tmp_path):
    plan = planned("ramp_single.bench_narrow.focus_stage_offset.weak", tmp_path)
    effects = [{name: dict(one.scene.effects[name]) for name in plan.mild.effects} for one in plan.recordings]
    assert [key for key, _ in groupby(effects)] == [effects[0]]


# -- judging -----------------------------------------------------------------------------------


def test_a_mild_error_that_is_there_is_no_wrong_name():
    one = outcome("vibration", "plate_scale", "vibration")
    assert is_named(one) and not is_first(one) and not first_is_wrong(one) and is_right(one)


def test_a_first_name_of_something_that_is_not_there_is_wrong():
    one = outcome("vibration", "phase_bump", "vibration")
    assert is_named(one) and first_is_wrong(one) and not is_right(one)
    assert wrong_names(one) == ["phase_bump"]


def test_a_name_that_is_not_distinguished_from_the_hidden_effect_is_not_wrong():
    one = outcome("plate_scale", "spectrum")
    one["diagnosis"]["steps"][0]["indistinguishable"] = ["plate_scale"]
    assert not is_named(one) and is_in_some_set(one) and not first_is_wrong(one)


@pytest.mark.parametrize("effect", ["companion", "ghost"])
@pytest.mark.parametrize(("sep_mas", "wrong"), [(110.0, False), (200.0, True)])
def test_a_second_image_is_right_where_the_ghost_is(effect, sep_mas, wrong):
    found = {"flux_ratio": 0.003, "sep_mas": sep_mas, "pa_deg": 31.0}
    assert first_is_wrong(outcome("vibration", effect, parameters=found)) is wrong


def test_a_hidden_companion_is_not_named_by_the_ghost():
    known = {"companion": {"flux_ratio": 0.01, "sep_mas": 200.0, "pa_deg": 210.0}}
    at_ghost = {"flux_ratio": 0.003, "sep_mas": 100.0, "pa_deg": 30.0}
    ghost = outcome("companion", "companion", known=known, parameters=at_ghost)
    found = outcome("companion", "companion", known=known, parameters=known["companion"])
    assert (is_named(ghost), first_is_wrong(ghost)) == (False, False)
    assert (is_first(found), first_is_wrong(found)) == (True, False)


def test_a_hidden_ghost_called_a_companion_in_its_place_is_not_wrong_but_not_named():
    one = outcome("ghost", "companion", known={"ghost": GHOST}, parameters=GHOST)
    one["truth"]["mild"] = {}
    assert not is_named(one) and not first_is_wrong(one)


def test_either_of_two_hidden_effects_may_be_named_first_and_a_companion_in_its_place_only():
    known = {"companion": {"flux_ratio": 0.01, "sep_mas": 200.0, "pa_deg": 210.0}}

    def pair(*names, parameters):
        one = outcome("companion", *names, kind=PAIR, known=known, parameters=parameters)
        return one | {"truth": one["truth"] | {"effects": ["companion", "vibration"]}}

    found = pair("vibration", "companion", parameters=known["companion"])
    at_ghost = pair("vibration", "companion", parameters=GHOST)
    assert (is_right(found), first_is_wrong(found)) == (True, False)
    assert (is_right(at_ghost), first_is_wrong(at_ghost)) == (False, False)


def test_with_nothing_hidden_or_nothing_that_can_be_named_only_wrong_names_count():
    assert is_right(outcome("", kind=CLEAN, verdict="unknown"))
    assert is_right(outcome("", "plate_scale", kind=CLEAN))
    assert not is_right(outcome("scratch", "phase_bump", kind=OUTSIDE))
    assert not is_right(outcome("vibration", "plate_scale", kind=PAIR))


def test_what_the_data_cannot_show_is_untestable_beside_right_names_only():
    told = {"untestable": ["diversity_error"]}
    assert is_untestable(outcome("diversity_error", "plate_scale", **told))
    assert not is_untestable(outcome("diversity_error", "phase_bump", **told))


@pytest.mark.parametrize(
    ("reported", "expected"),
    [
        ({"verdict": "effect", "unexplained": True}, "partial"),
        ({"verdict": "effect", "unexplained": False}, "complete"),
        ({"verdict": "unknown", "unexplained": True}, "unknown"),
        ({"verdict": "unknown", "grade": "resembles"}, "resembles"),
        ({"verdict": "none"}, "none"),
    ],
)
def test_a_report_without_a_grade_has_that_of_its_verdict(reported, expected):
    assert grade(outcome("vibration", **reported)) == expected


def test_the_table_counts_what_was_made_by_hand(tmp_path):
    outcomes = [
        outcome("vibration", "vibration"),
        outcome("vibration", "plate_scale", "vibration", unexplained=True),
        outcome("vibration", "phase_bump", unexplained=True),
        outcome("vibration", verdict="unknown"),
        outcome("", "phase_bump", kind=CLEAN),
    ]
    parts = score_dirty(outcomes)
    rows = {row.what: row.value for row in parts["one effect beside mild errors"]}
    assert [rows[what].count for what in ("named", "named first", "wrong first name", "no name")] == [
        2,
        1,
        1,
        1,
    ]
    assert rows["named"].total == 4
    grades = [(row.what, row.value.count) for row in parts["one effect beside mild errors, by grade"]]
    assert grades[4:8] == [("partial", 2), ("  named", 1), ("  named first", 0), ("  wrong first name", 1)]
    text = write_report(outcomes, {}, tmp_path)
    assert "dirty.single.vibration.phase_bump: partial, gap 4.00% to 2.00%, floor 1.00%: phase_bump" in text
    reported = json.loads((tmp_path / "suite.json").read_text())["outcomes"]
    assert [one["wrong_first_name"] for one in reported] == [False, False, True, False, True]


def test_what_mild_errors_hide_is_small_beside_them_and_counted_apart():
    """A vibration of 4 mas, from three times 1 mas on, where mild errors let 2 mas be seen."""
    hidden = outcome("vibration")
    hidden["truth"]["sizes"] = {"vibration": {"sigma_mas": 4.0}}
    alone = outcome("", kind=CLEAN, mdb={"vibration": {"sigma_mas": 1.0}, "companion": {"flux_ratio": 0.1}})
    alone["truth"]["dirty"] = False
    beside = outcome("", kind=CLEAN, mdb={"vibration": {"sigma_mas": 2.0}})
    outcomes = [hidden, alone, beside]
    assert smallest_sizes(outcomes, dirty=True)["bench_narrow"]["companion"]["flux_ratio"] == 0.1
    assert sorted_singles(outcomes, dirty=True).small == [hidden]
    parts = {part: {row.what: row.value for row in rows} for part, rows in score_dirty(outcomes).items()}
    assert parts["one effect beside mild errors"]["named"].total == 0
    assert parts["one effect beside mild errors, from 3 MDB without these on"]["named"].total == 1


def test_outcomes_of_another_seed_are_not_taken_for_those_asked_for(tmp_path):
    folder, case = Folder(tmp_path), dirty("single.bench_narrow.vibration.weak")
    folder.outcome(case).parent.mkdir()
    folder.outcome(case).write_text(json.dumps(outcome("vibration") | {"case": case.name}))
    assert work(case, folder)["case"] == case.name
    other = Case(**{**vars(case), "suite_seed": 5})
    with pytest.raises(ValueError, match="has the seed 0, not 5; give another folder"):
        work(other, folder)
