"""The hidden-effect suite: its cases, its judgement and its scores, and two recordings from beginning to end.

Truth: outcomes made by hand, whose scores can be counted; the sizes of the errors as the suite states them;
images whose moments are known.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.diagnose_suite.cases import (
    CLEAN,
    LEVELS,
    OUTSIDE,
    PAIR,
    RAMP_SINGLE,
    SETTINGS,
    SINGLE,
    Case,
    Setting,
    all_cases,
    in_one_setting,
    size_of,
)
from benchmarks.diagnose_suite.foreign import displaced_rows, seen_aslant
from benchmarks.diagnose_suite.hidden import LAWS, drawn_mild
from benchmarks.diagnose_suite.judging import (
    all_named,
    extra_names,
    first_is_wrong,
    grade,
    in_smallest,
    is_first,
    is_in_set,
    is_in_some_set,
    is_named,
    is_right,
    is_untestable,
    smallest_sizes,
    sorted_singles,
    true_size_inside,
)
from benchmarks.diagnose_suite.making import hidden_in, plan_case
from benchmarks.diagnose_suite.scoring import score, score_dirty, write_report
from benchmarks.diagnose_suite.working import RECIPES, SUITE, main, settings_of
from benchmarks.harness import chosen, keep, read_lines, worked
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.recipe import load_recipe
from irlos_pipe.simulate.effects import effects_of
from irlos_pipe.simulate.recordings.files import side_car

CASES = all_cases()
DIRTY = all_cases(dirty=True)
# The suite moves its focus in a slow beam, has no lenslets, and petals are those of `low_wind_effect`.
# The window of the suite does not show the edge of the corrected field, and half of it has no AO residual.
ELSEWHERE = {
    "lenslet_images", "correlated_noise", "high_aperture", "segment_piston", "ao_cutoff", "uneven_residual",
}  # fmt: skip
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


def test_every_effect_of_the_catalogue_is_hidden_at_every_level_in_every_setting():
    found = {(case.effects[0], case.level, case.setting.name) for case in CASES if case.kind == SINGLE}
    on_ramps = {(case.effects[0], case.level) for case in CASES if case.kind == RAMP_SINGLE}
    catalogue = {name for name in CATALOGUE if name not in ELSEWHERE}
    cubes = {name for name in catalogue if not name.startswith("focus_stage")}
    assert found == set(product(cubes, LEVELS, SETTINGS))
    assert on_ramps == set(product(catalogue - cubes, LEVELS))
    for name, setting in product(catalogue, SETTINGS):
        sizes = [size_of(name, setting, level) for level in LEVELS]
        assert sizes == sorted(set(sizes))


def test_names_seeds_and_random_order_are_each_case_s_and_each_suite_seed_s_own():
    first, second = ([case.seed for case in all_cases(seed, dirty=True)] for seed in (0, 1))
    assert len({*first, *second}) == 2 * len(first)
    listed = [
        CliRunner().invoke(main, ["--list", "--shuffled", "--seed", seed]).output.splitlines()
        for seed in ("5", "5", "6")
    ]
    assert listed[0] == listed[1] != listed[2]
    assert sorted(listed[0]) == sorted(listed[2]) == sorted(case.name for case in CASES)


def test_each_case_in_one_setting_has_all_cases_and_all_settings_alike():
    once = in_one_setting(CASES)
    hidden = Counter((one.kind, one.effects, one.level, one.number) for one in once)
    assert set(hidden) == {(one.kind, one.effects, one.level, one.number) for one in CASES}
    assert set(hidden.values()) == {1}
    singles = Counter(one.setting.name for one in once if one.kind == SINGLE)
    assert set(singles) == {*SETTINGS}
    assert max(singles.values()) - min(singles.values()) <= 1


def planned(name, tmp_path):
    (case,) = chosen(DIRTY if name.startswith("dirty") else CASES, name)
    return plan_case(case, tmp_path / "spec.yaml")


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


def test_a_model_that_lacks_nothing_has_what_the_recipe_has_and_what_is_hidden():
    for effect in ("vibration", "amplitude_aberration"):
        case = Case(SINGLE, SETTINGS["sky_narrow"], (effect,), "weak")
        known = {one.effect: one.known for one in hidden_in(case)}
        effects = case.true_model(known)
        assert effects == ["seeing_halo", "tip_tilt_jitter", known]
        recipe = load_recipe(RECIPES / "diagnose.yaml", settings_of(effects), complete=False)
        assert recipe.model.entries()[-1].values == known[effect]
    usual = Case(SINGLE, SETTINGS["sky_narrow"], ("seeing_halo",), "weak")
    assert usual.true_model({"seeing_halo": {"wfe_nm": 99.0}}) == ["seeing_halo", "tip_tilt_jitter"]


# -- effects outside the catalogue -------------------------------------------------------------


def blob(y_px=4.0, x_px=6.0, width_px=3.0) -> np.ndarray:
    y, x = np.mgrid[:64, :64] - 31.5
    return np.exp(-((x - x_px) ** 2 + (y - y_px) ** 2) / (2 * width_px**2))


def test_displaced_rows_move_by_their_shifts_and_keep_their_light():
    shifts = np.random.default_rng(1).uniform(-0.4, 0.4, 64)
    moved, columns = displaced_rows(blob(), shifts), np.arange(64)
    for row in range(28, 44):
        assert moved[row].sum() == pytest.approx(blob()[row].sum(), rel=1e-6)
        middle, before = (one[row] @ columns / one[row].sum() for one in (moved, blob()))
        assert middle - before == pytest.approx(shifts[row], abs=1e-4)


@pytest.mark.parametrize("place", [(12.0, 9.0), (-14.0, 6.0), (0.0, 0.0)])
def test_a_plane_seen_aslant_moves_blobs_by_perspective_and_keeps_their_light(place):
    """Projective geometry: the centroid of a small blob moves to r / (1 − slope·r)."""
    slope, small = np.array([0.002, -0.001]), blob(*place, 1.5)
    seen = seen_aslant(small, slope)
    assert seen.sum() == pytest.approx(small.sum(), rel=1e-4)
    y, x = np.mgrid[:64, :64] - 31.5
    centroid = np.array([np.sum(seen * y), np.sum(seen * x)]) / seen.sum()
    assert centroid == pytest.approx(np.array(place) / (1 - slope @ place), abs=0.02)  # the blob is no point


# -- mild errors of everything -----------------------------------------------------------------


@pytest.mark.parametrize("setting", SETTINGS.values(), ids=lambda one: one.name)
def test_everything_is_wrong_by_the_stated_size_and_in_either_direction(setting):
    hole_m = load_instrument("irlos").facility.pupil.obscuration_m
    found = [drawn_mild(setting, np.random.default_rng(seed)) for seed in range(40)]
    effects = [one.effects for one in found]
    centre_nm = {"narrow_h": 1600.0, "j_h": (1215.0 + 1625.0) / 2}[setting.bands]
    stops = [one["pupil_misregistration"] for one in effects]
    assert [np.hypot(one["dx_m"], one["dy_m"]) for one in stops] == pytest.approx([0.05] * 40)
    signed = {
        3.0: [one["rotation_deg"] for one in stops],
        0.005: [one["plate_scale"]["fraction"] for one in effects],
        5.0: [one["spectrum"]["wavelength_nm"] - centre_nm for one in effects],
        0.1: [one.sections["pupil"]["obscuration_m"] / hole_m - 1 for one in found],
    }
    for size, several in signed.items():
        assert np.abs(several) == pytest.approx(size) and set(np.sign(several)) == {-1.0, 1.0}
    laws = {one.sections["sky"]["shape"] for one in found if "sky" in one.sections}
    assert laws == ({law["shape"] for law in LAWS} if setting.on_sky else set())


def test_the_simulated_telescope_has_the_errors_and_the_side_car_those_of_none(tmp_path):
    plan = planned("dirty.single.sky_narrow.companion.medium", tmp_path)
    scene = plan.recordings[0].scene
    assert scene.geometry.obscuration_m == plan.mild.sections["pupil"]["obscuration_m"]
    assert {"plate_scale", "spectrum", "pupil_misregistration", "ghost", "companion"} == set(scene.effects)
    assert max(scene.ncpa_nm) == 200 and scene.detector.flat_error_rms == 0.005
    law = {"shape": scene.sky.shape, "outer_scale_m": scene.facility.outer_scale_m}
    assert law.items() <= plan.mild.sections["sky"].items()
    nominal = planned("single.sky_narrow.companion.medium", tmp_path).recordings[0]
    told, expected = (side_car(one) | {"seeing_arcsec": 0} for one in (plan.recordings[0], nominal))
    assert told == expected


@pytest.mark.parametrize(
    ("effect", "key"),
    [("plate_scale", "fraction"), ("pupil_misregistration", "dx_m"), ("ghost", "flux_ratio")],
)
def test_what_is_hidden_takes_the_place_of_the_mild_error_of_its_kind(effect, key, tmp_path):
    plan = planned(f"dirty.single.bench_narrow.{effect}.strong", tmp_path)
    (hidden,), effects = plan.hidden, plan.recordings[0].scene.effects
    assert effects[effect][key] == hidden.parameters[key]
    assert effect not in plan.mild.truth
    assert ("spectrum" in effects) == (effect != "plate_scale")  # in a narrow band it scales the image, too


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
    ("names", "both"),
    [
        (("vibration", "companion"), True),
        (("companion", "tip_tilt_jitter|vibration"), True),
        (("companion|vibration",), False),
        (("companion",), False),
    ],
)
def test_a_pair_needs_a_name_for_each_of_its_effects_and_a_companion_in_its_place(names, both):
    assert all_named(outcome("companion vibration", *names, kind=PAIR)) is both
    for place in (APART, AT_GHOST):
        beside = dirty("companion vibration", *names, kind=PAIR, known=COMPANION, found=place)
        assert is_right(beside) is (both and place == APART)


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


def test_sizes_in_smallest_ones_add_in_squares_and_a_shift_of_the_band_counts_from_its_centre():
    modes = outcome("high_order_ncpa", sizes={"zernike_nm": {"31": 3.0, "33": 8.0}})
    smallest = {"high_order_ncpa": {"zernike_nm": {"31": 1.0, "33": 2.0}}}
    assert in_smallest(modes, smallest) == pytest.approx(5.0)
    band = outcome("spectrum", sizes={"wavelength_nm": 1606.0})
    assert in_smallest(band, {"spectrum": {"wavelength_nm": 2.0}}) == pytest.approx(3.0)
    assert np.isnan(in_smallest(band, {}))


# -- scores ------------------------------------------------------------------------------------


def test_an_effect_is_judged_from_three_times_the_median_of_what_clean_recordings_could_show():
    clean = [
        outcome("", kind=CLEAN, mdb={"companion": {"flux_ratio": size}}) for size in (0.001, 0.002, 0.009)
    ]
    large, small = (outcome("companion", "companion", sizes={"flux_ratio": s}) for s in (0.0061, 0.0059))
    hidden = outcome("diversity_error", untestable=["diversity_error"], sizes={"nm": 9.0})
    wrong = outcome("diversity_error", "companion", untestable=["diversity_error"])  # no excuse
    found = sorted_singles([*clean, large, small, hidden, wrong])
    assert smallest_sizes(clean)["bench_narrow"]["companion"]["flux_ratio"] == 0.002
    assert (found.testable, found.small, found.untestable) == ([large, wrong], [small], [hidden])


def test_what_mild_errors_hide_is_small_beside_them_and_counted_apart():
    """A vibration of 4 mas, from three times 1 mas on, where mild errors let 2 mas be seen."""
    hidden = dirty("vibration", sizes={"sigma_mas": 4.0})
    mdb = {"vibration": {"sigma_mas": 1.0}, "companion": {"flux_ratio": 0.1}}
    outcomes = [
        hidden,
        outcome("", kind=CLEAN, mdb=mdb),
        dirty("", kind=CLEAN, mdb={"vibration": {"sigma_mas": 2.0}}),
    ]
    assert smallest_sizes(outcomes, dirty=True)["bench_narrow"]["companion"]["flux_ratio"] == 0.1
    assert sorted_singles(outcomes, dirty=True).small == [hidden]
    parts = score_dirty(outcomes)
    assert values(parts, "one effect beside mild errors")["named"].total == 0
    assert values(parts, "one effect beside mild errors, from 3 MDB without these on")["named"].total == 1


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


@pytest.mark.slow
def test_the_table_beside_mild_errors_counts_what_was_made_by_hand(tmp_path):
    outcomes = [
        dirty("vibration", "vibration"),
        dirty("vibration", "plate_scale", "vibration", unexplained=True),
        dirty("vibration", "phase_bump", unexplained=True),
        dirty("vibration", verdict="unknown"),
        dirty("", "phase_bump", kind=CLEAN),
    ]
    parts = score_dirty(outcomes)
    rows = values(parts, "one effect beside mild errors")
    counts = [rows[what].count for what in ("named", "named first", "wrong first name", "no name")]
    assert counts == [2, 1, 1, 1] and rows["named"].total == 4
    grades = [(row.what, row.value.count) for row in parts["one effect beside mild errors, by grade"]]
    assert grades[4:8] == [("partial", 2), ("  named", 1), ("  named first", 0), ("  wrong first name", 1)]
    text = write_report(outcomes, {}, tmp_path)
    assert "single.vibration.phase_bump: partial, gap 4.00% to 2.00%, floor 1.00%: phase_bump" in text


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
