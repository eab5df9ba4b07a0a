"""The random instrument: what is drawn, how a calibration is judged, and one draw from beginning to end.

Truth: the limits of the errors as the page states them; outcomes written down by hand.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.random_instrument import table as tables
from benchmarks.random_instrument.cases import Case, all_cases
from benchmarks.random_instrument.kept import keep, lay_out
from benchmarks.random_instrument.scoring import SHAPES, judged
from benchmarks.random_instrument.tolerances import ERRORS, FILTER_NOLLS
from benchmarks.random_instrument.working import work
from irlos_pipe.conventions.modes import REPORTED_NOLLS
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.simulate.recordings.files import side_car

SPECS = [case.spec() for case in all_cases(1, 200, 0, 20)]
SMALL = Case(1, 0, 8, window=36)


def made(error_nm: float, pull: float, code: int, index: int = 0, diagnosed: bool = False) -> dict:
    """An outcome whose error is all in the defocus, and whose errors have one pull in all modes."""
    zernike_nm = {str(noll): 0.0 for noll in REPORTED_NOLLS} | {"4": error_nm}
    static_nm = {noll: zernike_nm[noll] - pull for noll in zernike_nm}
    found = {"zernike_nm": zernike_nm, "sigma_nm": dict.fromkeys(zernike_nm, 1.0), "exit_code": code}
    return {
        "index": index,
        "seeing_arcsec": Case(1, index, 20).seeing_arcsec,
        "shape": "servo_lag",
        "truth": {"mean_nm": {}, "static_nm": static_nm, "diversity_error_nm": {"6": 3.0}},
        "plain": found,
        "diagnosed": found | {"names": ["stop"], "grade": "partial"} if diagnosed else None,
    }


def cells(text: str) -> dict[str, list[str]]:
    """Rows of all tables by their first cell."""
    rows = ([cell.strip() for cell in line.strip("| ").split("|")] for line in text.splitlines() if line)
    return {row[0]: row[1:] for row in rows}


@pytest.mark.parametrize(
    ("value", "limit"),
    [
        (lambda one: one["effects"]["plate_scale"]["fraction"], 0.005),
        (lambda one: one["effects"]["spectrum"]["wavelength_nm"] - 1600, 5.0),
        (lambda one: one["effects"]["pupil_misregistration"]["rotation_deg"], 3.0),
        (lambda one: one["effects"]["diversity_error"]["nm"], 10.0),
        (lambda one: one["pupil"]["obscuration_m"] / 1.116 - 1, 0.1),
    ],
    ids=["plate scale", "band", "vanes", "diversity", "obscuration"],
)
def test_errors_with_a_sign_fill_their_limits_and_stay_within(value, limit):
    values = np.array([value(one) for one in SPECS])
    assert np.abs(values).max() <= limit
    assert values.min() < -0.9 * limit and values.max() > 0.9 * limit


def test_the_other_errors_have_their_size_in_every_draw():
    for spec in SPECS:
        effects = spec["effects"]
        stop = effects["pupil_misregistration"]
        assert np.hypot(stop["dx_m"], stop["dy_m"]) == pytest.approx(0.05)
        filter_nm = effects["filter_ncpa"]["zernike_nm"]
        assert np.linalg.norm(list(filter_nm.values())) == pytest.approx(30) and set(filter_nm) == set(
            FILTER_NOLLS
        )
        assert effects["ghost"]["flux_ratio"] == 0.003
        assert spec["ncpa"]["tail_nm"] == 2.0 and spec["ncpa"]["tail_nolls"] == [52, 200]
        assert spec["detector"]["flat_error_rms"] == 0.005
        assert spec["sky"]["outer_scale_m"] in (12.5, 50.0)


def test_stars_are_blue_in_h_and_cool_ones_less():
    """Photons per wavelength of a black body: −4 + x/(1 − e^−x) at 1.6 µm, −0.53 and −1.62 per µm."""
    slopes = [spec["effects"]["spectrum"]["slope"] for spec in SPECS]
    assert min(slopes) >= -1.62 and max(slopes) <= -0.52


def test_half_of_the_draws_have_either_seeing_and_the_ncpas_are_those_of_the_paper():
    seeings = [spec["sky"]["seeing_arcsec"] for spec in SPECS]
    assert seeings.count(0.35) == seeings.count(1.0) == 100
    assert np.mean([spec["ncpa"]["total_nm"] for spec in SPECS]) == pytest.approx(142, abs=3 * 30 / 200**0.5)


def test_more_draws_leave_the_first_ones_as_they_are():
    assert all_cases(1, 8, 4, 20)[:4] == all_cases(1, 4, 4, 20)
    assert len({case.name for case in all_cases(1, 8, 4, 20)}) == 8


@pytest.mark.parametrize("error", ERRORS)
def test_an_error_left_out_leaves_all_others(error):
    whole, rest = SMALL.spec(), replace(SMALL, without=error).spec()
    assert whole != rest
    missing = {
        (section, name, key)
        for section in ("effects", "pupil", "sky", "ncpa", "detector")
        for name, keys in _by_name(whole, section).items()
        for key in keys
        if key not in _by_name(rest, section).get(name, {})
    }
    assert missing
    for section in ("effects", "pupil", "sky", "ncpa", "detector"):
        for name, keys in _by_name(rest, section).items():
            assert keys.items() <= _by_name(whole, section)[name].items()


def _by_name(spec: dict, section: str) -> dict[str, dict]:
    return spec[section] if section == "effects" else {section: spec.get(section, {})}


def test_the_side_car_is_that_of_the_nominal_instrument(tmp_path):
    planned = SMALL.planned(tmp_path / "spec.yaml")
    told = side_car(planned)
    assert (told["pixel_scale_mas"], told["diversity"]["zernike"]) == (9.7, {6: -170.0})
    assert [one["wavelength_nm"] for one in told["spectrum"]][1] == 1600.0
    nominal = load_instrument("irlos").facility.pupil.obscuration_m
    assert planned.scene.geometry.obscuration_m != nominal and "effects" not in told


def test_an_error_counts_without_and_with_that_of_the_diversity():
    one = judged(made(4.0, 2.0, 0), "plain")
    assert (one.error_nm, one.shape_nm, one.defocus_nm, one.strict_nm) == (4.0, 4.0, 4.0, 5.0)
    assert len(one.pulls) == len(SHAPES) == 27 and one.pull == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("error_nm", "pull", "bad"), [(11.0, 2.9, False), (13.0, 1.0, True), (1.0, 3.1, True)]
)
def test_bad_is_a_large_error_or_a_large_pull(error_nm, pull, bad):
    assert judged(made(error_nm, pull, 0), "plain").bad is bad


def test_the_tables_count_lights_and_take_medians():
    some = [
        made(2.0, 1.0, 0, 0, True),
        made(4.0, 1.0, 4, 1, True),
        made(20.0, 1.0, 4, 2),
        made(30.0, 5.0, 0, 3),
    ]
    rows = cells(tables.tables(some))
    assert rows["error of Noll 2–30, median"][1].startswith("12.0 nm")
    assert rows["error of Noll 2–30, median"][3].startswith("3.0 nm")
    assert rows["pull of Noll 4–30, RMS"][1].startswith(f"{np.sqrt(28 / 4):.2f}")
    assert rows["… where bad"][1].startswith("1 of 2") and rows["… where good"][1].startswith("1 of 2")
    assert rows["the light is right"][1].startswith("2 of 4")
    assert rows["0"][2:5] == ["2.0 → 2.0 nm", "1.0 → 1.0", "green → green"]


def test_intervals_of_a_median_hold_what_order_statistics_say():
    """Of 100 values the 95 % interval of the median reaches about from the 40th to the 61st."""
    low, high = tables.interval(np.arange(1.0, 101.0).tolist(), np.median)
    assert low == pytest.approx(40, abs=2) and high == pytest.approx(61, abs=2)


def test_the_tables_stand_between_their_marks(tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- random instrument -->\nold\n<!-- /random instrument -->\nafter\n")
    monkeypatch.setattr(tables, "PAGE", page)
    tables.write_page("new")
    assert page.read_text() == (
        "before\n<!-- random instrument -->\n\nnew\n\n<!-- /random instrument -->\nafter\n"
    )


def test_what_is_kept_is_not_drawn_again_and_has_the_same_tables(tmp_path):
    file, folder = tmp_path / "kept.jsonl", tmp_path / "run"
    some = [made(2.0, 1.0, 0, 0, True), made(4.0, 1.0, 4, 1)]
    some = [{**one, "seed": 1, "frames": 20, "without": ""} for one in some]
    some[0]["truth"] = {**some[0]["truth"], "mean_nm": {"4": 0.0, "31": 9.0}}
    keep(file, some[:1])
    keep(file, [{**some[0], "seed": 2}])
    keep(file, some[1:])
    folder.mkdir()
    cases = all_cases(1, 3, 1, 20)
    lay_out(file, cases, folder)
    assert sorted(path.stem for path in folder.iterdir()) == sorted(one.name for one in cases[:2])
    kept = [work(case, folder) for case in cases[:2]]
    assert tables.tables(kept) == tables.tables(some)
    assert kept[0]["truth"]["mean_nm"] == {"4": 0.0}


@pytest.mark.slow
def test_a_draw_is_simulated_calibrated_and_kept(tmp_path):
    outcome = work(SMALL, tmp_path)
    scene, static_nm = SMALL.planned(tmp_path / "spec.yaml").scene, outcome["truth"]["static_nm"]
    effects = scene.effects
    filter_nm, missed_nm = effects["filter_ncpa"]["zernike_nm"], effects["diversity_error"]["nm"]
    assert static_nm["6"] == pytest.approx(scene.ncpa_nm[6] + filter_nm[6] - missed_nm)
    assert outcome["truth"]["diversity_error_nm"]["6"] == pytest.approx(-missed_nm)
    one = judged(outcome, "plain")
    assert one.error_nm < np.linalg.norm([static_nm[str(noll)] for noll in REPORTED_NOLLS]) / 2
    assert one.red == bool(outcome["plain"]["failed"])
    (tmp_path / "spec.yaml").unlink()
    assert work(SMALL, tmp_path) == outcome
    with pytest.raises(ValueError, match="another seed"):
        work(replace(SMALL, seed=2), tmp_path)
