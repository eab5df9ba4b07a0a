"""The hidden-effect suite: its table of cases, its scores, and one recording from beginning to end.

Truth: outcomes made by hand, whose scores can be counted; intervals of Clopper and Pearson from their own
closed form; images whose moments are known.
"""

from __future__ import annotations

import json
from collections import Counter
from itertools import product

import numpy as np
import pytest
from click.testing import CliRunner
from helpers.paths import REPOSITORY

from benchmarks.diagnose_suite.__main__ import chosen, main, run_all
from benchmarks.diagnose_suite.cases import (
    CLEAN,
    OUTSIDE,
    PAIR,
    RAMP_SINGLE,
    RAMPS,
    SINGLE,
    Case,
    all_cases,
    in_one_setting,
)
from benchmarks.diagnose_suite.confusion import Confusion
from benchmarks.diagnose_suite.foreign import FOREIGN, displaced_rows, seen_aslant
from benchmarks.diagnose_suite.groups import smallest_sizes, sorted_singles
from benchmarks.diagnose_suite.hidden import drawn
from benchmarks.diagnose_suite.judging import all_named, extra_names, is_first, is_in_set, is_right
from benchmarks.diagnose_suite.levels import LEVELS, size_of
from benchmarks.diagnose_suite.planning import plan_case, spec_of
from benchmarks.diagnose_suite.rates import Rate
from benchmarks.diagnose_suite.report import write_report
from benchmarks.diagnose_suite.scoring import bias_removed, score
from benchmarks.diagnose_suite.settings import SETTINGS, Setting
from benchmarks.diagnose_suite.sizes import in_smallest, true_size_inside
from benchmarks.diagnose_suite.working import RECIPES, Folder, settings_of, with_noll_indices
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.recipe import load_recipe
from irlos_pipe.simulate.effects import effects_of
from irlos_pipe.simulate.recordings.files import side_car
from irlos_pipe.simulate.recordings.series import plan_recordings
from irlos_pipe.simulate.recordings.spec import load_spec

CASES = all_cases()
# The suite moves its focus in a slow beam, has no lenslets, and petals are those of `low_wind_effect`.
# The window of the suite does not show the edge of the corrected field, and half of it has no AO residual.
ELSEWHERE = {
    "lenslet_images", "correlated_noise", "high_aperture", "segment_piston", "ao_cutoff", "uneven_residual",
}  # fmt: skip
SMALL_MDB = {"companion": {"flux_ratio": 0.001}}


def outcome(
    kind, hidden=(), verdict="none", names=(), *, sizes=None, found=None, sigma=None, **reported
) -> dict:
    """What a case came to: `names` are the names found, each with those it was not distinguished from."""
    steps = [
        {"effect": name, "indistinguishable": list(others), "parameters": found or {}, "sigma": sigma or {}}
        for name, *others in (one.split("|") for one in names)
    ]
    return {
        "case": f"{kind}.{'+'.join(hidden)}.{verdict}",
        "truth": {
            "kind": kind,
            "setting": "bench_narrow",
            "level": "weak",
            "effects": list(hidden),
            "sizes": {hidden[0]: sizes} if sizes else {},
        },
        "diagnosis": {
            "verdict": verdict,
            "steps": steps,
            "untestable": reported.get("untestable", []),
            "mdb": reported.get("mdb", {}),
            "gap": {"shrink": reported.get("shrink")},
            "seconds": 30.0,
        },
        "ncpa_error_nm": reported.get("errors", {"before": 1.0, "after": 1.0}),
        "ncpa_bias_nm": reported.get("biases"),
        "cpu_s": {"simulate": 1.0, "diagnose": 20.0},
    }


def single(effect, *names, verdict="effect", **more) -> dict:
    return outcome(SINGLE, (effect,), verdict, names, **more)


def seen(effect, **more) -> dict:
    """An effect found with its size, in a unit of its own."""
    return single(effect, effect, sizes={"size": 1.0}, found={"size": 1.1}, sigma={"size": 0.1}, **more)


def numbers(outcomes, part) -> dict:
    return {row.what.strip(): row.value for row in score(outcomes)[part]}


# -- the table of cases ------------------------------------------------------------------------


def test_every_effect_of_the_catalogue_is_hidden_at_every_level_in_every_setting():
    found = {(case.effects[0], case.level, case.setting.name) for case in CASES if case.kind == SINGLE}
    on_ramps = {(case.effects[0], case.level) for case in CASES if case.kind == RAMP_SINGLE}
    catalogue = [name for name in CATALOGUE if name not in ELSEWHERE]
    cubes = [name for name in catalogue if not name.startswith("focus_stage")]
    assert len(catalogue) == 27
    assert found == set(product(cubes, LEVELS, SETTINGS))
    assert on_ramps == set(product(set(catalogue) - set(cubes), LEVELS))


def test_the_settings_are_bench_and_sky_in_narrow_and_broad_bands_with_a_dozen_clean_cubes_each():
    clean = [case.setting.name for case in CASES if case.kind == CLEAN]
    assert set(clean) == {"bench_narrow", "bench_broad", "sky_narrow", "sky_broad"}
    assert len(clean) >= 40
    assert min(clean.count(name) for name in SETTINGS) >= 10


def test_at_least_six_effects_are_outside_the_catalogue_and_meet_every_setting():
    hidden = {(case.effects[0], case.setting.name) for case in CASES if case.kind == OUTSIDE}
    assert hidden == set(product(FOREIGN, SETTINGS))
    assert len(set(FOREIGN) - set(CATALOGUE)) >= 6


def test_names_and_seeds_are_each_case_s_own():
    assert len({case.name for case in CASES}) == len({case.seed for case in CASES}) == len(CASES)


def test_the_documents_tell_how_many_cases_there_are():
    reported = (REPOSITORY / "docs" / "diagnose_suite.md").read_text()
    kinds = [case.kind for case in CASES]
    for kind in (CLEAN, SINGLE, PAIR, OUTSIDE):
        assert f"| `{kind}` | {kinds.count(kind)} |" in reported


def test_a_level_is_larger_than_the_one_before():
    for name, setting in product(set(CATALOGUE) - ELSEWHERE, SETTINGS):
        sizes = [size_of(name, setting, level) for level in LEVELS]
        assert sizes == sorted(set(sizes))


def planned(tmp_path, spec):
    path = tmp_path / "spec.yaml"
    path.write_text(yaml_text(spec))
    return plan_recordings(load_spec(path))


@pytest.mark.parametrize(
    "case", [c for c in CASES if c.kind in (SINGLE, PAIR, RAMP_SINGLE)][::15], ids=lambda c: c.name
)
def test_every_hidden_effect_is_a_valid_simulation(case, tmp_path):
    plan = plan_case(case, tmp_path / "spec.yaml")
    effects_of({one.effect: one.parameters for one in plan.hidden})
    assert [one.effect for one in plan.hidden] == list(case.effects)


@pytest.mark.parametrize(
    "name", ["single.bench_narrow.spectrum.strong", "pair.sky_broad.companion+vibration.00"]
)
def test_the_side_car_is_the_same_with_and_without_what_is_hidden(name, tmp_path):
    (case,) = chosen(CASES, name)
    hidden = plan_case(case, tmp_path / "truth.yaml").recordings
    assert [side_car(one) for one in hidden] == [
        side_car(one) for one in planned(tmp_path, spec_of(case, []))
    ]


def test_where_the_sky_s_own_residual_or_motion_is_hidden_the_model_begins_without_it():
    (case,) = (c for c in CASES if c.name == "single.sky_narrow.seeing_halo.weak")
    assert case.model_effects == ("tip_tilt_jitter",)


def test_a_sample_is_spread_over_the_kinds():
    assert {case.kind for case in chosen(CASES, sample=60)} >= {CLEAN, SINGLE, PAIR, OUTSIDE}
    assert all(case.kind in RAMPS for case in chosen(CASES, "ramp_*"))


def test_each_case_in_one_setting_has_all_cases_and_all_settings_alike():
    once = in_one_setting(CASES)
    hidden = Counter((one.kind, one.effects, one.level, one.number) for one in once)
    assert set(hidden) == {(one.kind, one.effects, one.level, one.number) for one in CASES}
    assert set(hidden.values()) == {1}
    singles = Counter(one.setting.name for one in once if one.kind == SINGLE)
    assert set(singles) == {*SETTINGS}
    assert max(singles.values()) - min(singles.values()) <= 1


# -- effects outside the catalogue -------------------------------------------------------------


def blob() -> np.ndarray:
    y, x = np.mgrid[:64, :64] - 31.5
    return np.exp(-((x - 6) ** 2 + (y - 4) ** 2) / (2 * 3.0**2))


def centroid(image: np.ndarray) -> np.ndarray:
    """(y, x) from the axis."""
    y, x = np.mgrid[:64, :64] - 31.5
    return np.array([np.sum(image * y), np.sum(image * x)]) / image.sum()


def test_displaced_rows_move_by_their_shifts_and_keep_their_light():
    shifts = np.random.default_rng(1).uniform(-0.4, 0.4, 64)
    moved, columns = displaced_rows(blob(), shifts), np.arange(64)
    for row in range(28, 44):
        assert moved[row].sum() == pytest.approx(blob()[row].sum(), rel=1e-6)
        middle, before = (one[row] @ columns / one[row].sum() for one in (moved, blob()))
        assert middle - before == pytest.approx(shifts[row], abs=1e-4)


def test_a_plane_seen_aslant_moves_blobs_by_perspective_and_keeps_their_light():
    """Projective geometry: the centroid of a small blob moves to r / (1 − slope·r)."""
    slope = np.array([0.002, -0.001])
    y, x = np.mgrid[:64, :64] - 31.5
    for place in ((12.0, 9.0), (-14.0, 6.0), (0.0, 0.0)):
        small = np.exp(-((y - place[0]) ** 2 + (x - place[1]) ** 2) / (2 * 1.5**2))
        seen = seen_aslant(small, slope)
        assert seen.sum() == pytest.approx(small.sum(), rel=1e-4)
        expected = np.array(place) / (1 - slope @ place)
        assert centroid(seen) == pytest.approx(expected, abs=0.02)  # the blob is not a point


@pytest.mark.parametrize("name", [name for name in FOREIGN if name != "scratch"])
def test_what_is_outside_the_catalogue_changes_the_image_by_more_than_rounding(name):
    foreign = FOREIGN[name](np.random.default_rng(4))
    changed = np.abs(foreign.image(blob()) - blob()).sum() / blob().sum()
    assert 0.002 < changed < 0.3


def test_a_scratch_crosses_the_pupil():
    foreign = FOREIGN["scratch"](np.random.default_rng(4))
    (patch,) = foreign.patches
    ends = np.array([patch.start_m, patch.end_m])
    assert np.hypot(*ends.mean(axis=0)) < 4.0
    assert 2.5 <= np.hypot(*np.diff(ends, axis=0)[0]) <= 4.5


# -- judging -----------------------------------------------------------------------------------


def test_the_first_name_counts_and_so_does_a_set_of_three_that_holds_it_but_none_of_four():
    assert is_first(single("companion", "companion"))
    assert not is_first(single("companion", "vibration"))
    assert is_in_set(single("companion", "vibration|companion|phase_bump"))
    assert not is_in_set(single("companion", "vibration|companion|phase_bump|spectrum"))
    assert not is_in_set(single("companion", "vibration", "companion"))
    assert not is_in_set(single("companion", verdict="unknown"))


def test_a_further_name_that_is_not_there_makes_a_case_wrong():
    assert extra_names(single("companion", "companion", "vibration")) == ["vibration"]
    assert is_right(single("companion", "companion"))
    assert not is_right(single("companion", "companion", "vibration"))


@pytest.mark.parametrize(
    ("names", "both"),
    [
        (("companion", "vibration"), True),
        (("vibration", "companion"), True),
        (("companion", "tip_tilt_jitter|vibration"), True),
        (("companion|vibration",), False),
        (("companion",), False),
    ],
)
def test_a_pair_needs_a_name_for_each_of_its_effects(names, both):
    assert all_named(outcome(PAIR, ("companion", "vibration"), "effect", names)) is both


def test_a_size_is_inside_its_interval_up_to_two_standard_errors():
    def inside(found):
        one = single(
            "companion",
            "companion",
            sizes={"flux_ratio": 0.05},
            found={"flux_ratio": found, "sep_mas": 90.0},
            sigma={"flux_ratio": 0.001, "sep_mas": 1.0},
        )
        return true_size_inside(one)

    assert inside(0.0519) is True
    assert inside(0.0521) is False


def test_of_petals_the_common_piston_is_no_size():
    sizes = {"piston_nm": [10.0, -10.0, 30.0, -30.0]}
    found = {"piston_nm": [110.0, 90.0, 130.0, 70.0]}
    one = single(
        "low_wind_effect", "low_wind_effect", sizes=sizes, found=found, sigma={"piston_nm": [1.0] * 4}
    )
    assert true_size_inside(one) is True


def test_a_mode_that_is_missing_among_those_found_is_not_inside():
    one = single(
        "ncpa_drift",
        "ncpa_drift",
        sizes={"zernike_nm": {"4": 20.0, "7": 9.0}},
        found={"zernike_nm": {"4": 20.0}},
        sigma={"zernike_nm": {"4": 1.0}},
    )
    assert true_size_inside(one) is False


def test_sizes_in_smallest_ones_add_in_squares_and_a_shift_of_the_band_counts_from_its_centre():
    modes = single("high_order_ncpa", sizes={"zernike_nm": {"31": 3.0, "33": 8.0}})
    assert in_smallest(modes, {"high_order_ncpa": {"zernike_nm": {"31": 1.0, "33": 2.0}}}) == pytest.approx(
        5.0
    )
    band = single("spectrum", sizes={"wavelength_nm": 1606.0})
    assert in_smallest(band, {"spectrum": {"wavelength_nm": 2.0}}) == pytest.approx(3.0)
    assert np.isnan(in_smallest(band, {}))


# -- scores ------------------------------------------------------------------------------------


def test_rates_have_the_intervals_of_clopper_and_pearson():
    """Without an event the upper limit is 1 - (α/2)^(1/n)."""
    rate = Rate.of([False] * 48)
    assert (rate.count, rate.total, rate.low) == (0, 48, 0.0)
    assert rate.high == pytest.approx(1 - 0.025 ** (1 / 48))
    assert np.isnan(Rate.of([]).value)


def test_an_effect_is_judged_from_three_times_the_median_of_what_clean_recordings_could_show():
    clean = [outcome(CLEAN, mdb={"companion": {"flux_ratio": size}}) for size in (0.001, 0.002, 0.009)]
    large, small = (single("companion", "companion", sizes={"flux_ratio": size}) for size in (0.0061, 0.0059))
    hidden = single("diversity_error", verdict="none", untestable=["diversity_error"], sizes={"nm": 9.0})
    sorted_out = sorted_singles([*clean, large, small, hidden])
    assert smallest_sizes(clean)["bench_narrow"]["companion"]["flux_ratio"] == 0.002
    assert (sorted_out.testable, sorted_out.small, sorted_out.untestable) == ([large], [small], [hidden])


def test_what_was_found_for_something_untestable_is_an_error_and_no_excuse():
    wrong = single("diversity_error", "companion", untestable=["diversity_error"])
    assert sorted_singles([wrong]).testable == [wrong]


def test_the_table_counts_what_was_made_by_hand():
    outcomes = [
        outcome(CLEAN),
        outcome(CLEAN),
        outcome(CLEAN, (), "effect", ["companion"]),
        seen("companion", shrink=0.95),
        seen("vibration", shrink=0.85),
        single("phase_bump", "high_order_ncpa|phase_bump"),
        single("spectrum", verdict="unknown"),
        outcome(PAIR, ("companion", "vibration"), "effect", ["companion", "vibration"]),
        outcome(PAIR, ("companion", "vibration"), "effect", ["companion"]),
        outcome(OUTSIDE, ("scratch",), "unknown"),
        outcome(OUTSIDE, ("scratch",), "effect", ["phase_bump"]),
    ]
    clean, one = numbers(outcomes, "clean"), numbers(outcomes, "one effect")
    assert (clean["something called missing"].count, clean["something called missing"].total) == (1, 3)
    assert (one["named first"].count, one["named first, or in a set of <= 3"].count) == (2, 3)
    assert one["named first"].total == 4
    assert one["mean size of the first set"] == pytest.approx(4 / 3)
    other = numbers(outcomes, "other")
    assert other["pairs: both named"].value == 0.5
    assert other["outside the catalogue: unknown"].value == 0.5
    assert other["outside the catalogue: a confident wrong name"].count == 1
    assert numbers(outcomes, "model with what was found")["held-out gap: median shrink"] == pytest.approx(0.9)


def test_the_confusion_matrix_has_every_case_with_one_effect_in_its_cell():
    outcomes = [
        outcome(CLEAN),
        single("companion", "vibration"),
        single("low_wind_effect", "segment_piston"),
        outcome(OUTSIDE, ("scratch",), "unknown"),
        single("diversity_error", verdict="none", untestable=["diversity_error"]),
        outcome(PAIR, ("companion", "vibration"), "effect", ["companion"]),
    ]
    matrix = Confusion.of(outcomes)
    cells = {(matrix.rows[i], matrix.columns[j]) for i, j in np.argwhere(matrix.counts)}
    assert cells == {
        ("(nothing)", "none"),
        ("companion", "vibration"),
        ("low_wind_effect", "segment_piston"),
        ("(outside)", "unknown"),
        ("diversity_error", "(untestable)"),
    }


def test_a_bias_counts_beyond_what_the_true_model_errs_by():
    better = found_with((10.0, 8.5), (6.0, 2.9))
    halved = found_with((10.0, 4.9), (9.0, 3.0))
    slight = found_with((9.0, 9.0), (4.0, 4.0))
    assert bias_removed([better, halved, slight]) == ([False, True], [True, True])


def found_with(errors, biases) -> dict:
    before_after = [dict(zip(("before", "after"), pair, strict=True)) for pair in (errors, biases)]
    return single("companion", "companion", errors=before_after[0], biases=before_after[1])


def test_a_model_that_lacks_nothing_has_what_the_recipe_has_and_what_is_hidden():
    sky = SETTINGS["sky_narrow"]
    known = drawn("vibration", 20.0, sky, np.random.default_rng(1)).known
    assert set(known) == {"sigma_mas", "angle_deg"}
    case = Case(SINGLE, sky, ("vibration",), "weak")
    assert case.true_model({"vibration": known}) == ["seeing_halo", "tip_tilt_jitter", {"vibration": known}]
    usual = Case(SINGLE, sky, ("seeing_halo",), "weak")
    assert usual.true_model({"seeing_halo": {"wfe_nm": 99.0}}) == ["seeing_halo", "tip_tilt_jitter"]


def test_the_true_model_of_an_effect_with_a_table_can_be_given_to_a_recipe():
    """As it comes back from the file of the truth, whose keys are text."""
    sky = SETTINGS["sky_narrow"]
    known = {"amplitude_aberration": drawn("amplitude_aberration", 0.1, sky, np.random.default_rng(1)).known}
    reported = json.loads(json.dumps(known))
    effects = Case(SINGLE, sky, ("amplitude_aberration",), "weak").true_model(with_noll_indices(reported))
    recipe = load_recipe(RECIPES / "diagnose.yaml", settings_of(effects), complete=False)
    assert recipe.model.entries()[-1].values == known["amplitude_aberration"]


# -- from beginning to end ---------------------------------------------------------------------

SMALL = Setting("bench", "narrow_h", 8.0, frames=32, window=40)
SAMPLE = [
    Case(SINGLE, SMALL, ("companion",), "strong"),
    Case(RAMP_SINGLE, SMALL, ("focus_stage_offset",), "strong"),
]


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    folder = Folder(tmp_path_factory.mktemp("suite"))
    return folder, *run_all(SAMPLE, folder, jobs=1)


@pytest.mark.long
def test_a_companion_and_an_offset_of_the_focus_stage_are_found_with_their_sizes(suite):
    _, outcomes, failed = suite
    assert failed == {}
    assert [one["case"] for one in outcomes] == sorted(case.name for case in SAMPLE)
    assert all(is_right(one) for one in outcomes)
    companion = outcomes[-1]
    truth, (step,) = companion["truth"]["sizes"]["companion"], companion["diagnosis"]["steps"]
    assert step["parameters"]["flux_ratio"] == pytest.approx(truth["flux_ratio"], rel=0.03)
    assert companion["ncpa_error_nm"]["after"] < 0.5 * companion["ncpa_error_nm"]["before"]
    assert companion["ncpa_bias_nm"]["after"] < 0.2 * companion["ncpa_bias_nm"]["before"]


@pytest.mark.long
def test_the_truth_lies_outside_what_the_diagnosis_is_given(suite):
    folder, _, _ = suite
    given = [path.read_bytes() for path in (folder.path / "data").rglob("*") if path.is_file()]
    assert given
    assert not any(b"flux_ratio" in content or b"focus_stage" in content for content in given)


@pytest.mark.long
def test_finished_cases_are_kept_and_one_that_breaks_ends_no_other(suite):
    folder, outcomes, _ = suite
    before = {path: path.stat().st_mtime_ns for path in folder.path.rglob("*.*")}
    broken = Case(SINGLE, SMALL, ("no_such_effect",), "strong")
    again, failed = run_all([*SAMPLE, broken], folder, jobs=1)
    assert again == outcomes
    assert "no_such_effect" in failed[broken.name]
    assert {path: path.stat().st_mtime_ns for path in before} == before


@pytest.mark.long
def test_the_report_is_a_table_a_file_for_scripts_and_a_picture(suite, tmp_path):
    _, outcomes, _ = suite
    text = write_report(outcomes, {"clean.bench_narrow.00": "OSError: no space"}, tmp_path)
    reported = json.loads((tmp_path / "suite.json").read_text())
    assert "named first" in text
    assert "no space" in text
    assert reported["cases"] == 2
    assert [one["right"] for one in reported["outcomes"]] == [True, True]
    assert (tmp_path / "confusion.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_what_cannot_be_tested_is_listed_by_name(tmp_path):
    hidden = single("diversity_error", verdict="none", untestable=["diversity_error"], sizes={"nm": 9.0})
    assert "diversity_error, bench_narrow: 1" in write_report([hidden, outcome(CLEAN)], {}, tmp_path)


def test_the_list_of_cases_needs_no_folder():
    listed = CliRunner().invoke(main, ["--list", "--only", "pair.*"])
    assert listed.exit_code == 0
    assert len(listed.output.splitlines()) == sum(case.kind == PAIR for case in CASES)
