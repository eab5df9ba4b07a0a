"""The random instrument: what is drawn, how a calibration is judged, one draw to its end; and pulls.

Truth: the limits of the errors as the page states them; outcomes written down by hand.
"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import pulls
from benchmarks.random_instrument import (
    SHAPES,
    SUITE,
    Case,
    all_cases,
    interval,
    judged,
    slim,
    tables,
)
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


def test_stars_are_blue_in_h_and_cool_ones_less():
    """Photons per wavelength of a black body: −4 + x/(1 − e^−x) at 1.6 µm, −0.53 and −1.62 per µm."""
    slopes = [spec["effects"]["spectrum"]["slope"] for spec in SPECS]
    assert min(slopes) >= -1.62 and max(slopes) <= -0.52


def test_the_side_car_is_that_of_the_nominal_instrument(tmp_path):
    planned = SMALL.planned(tmp_path / "spec.yaml")
    declared = side_car(planned)
    assert (declared["pixel_scale_mas"], declared["diversity"]["zernike"]) == (9.7, {6: -170.0})
    assert [one["wavelength_nm"] for one in declared["spectrum"]][1] == 1600.0
    nominal = load_instrument("irlos").facility.pupil.obscuration_m
    assert planned.scene.geometry.obscuration_m != nominal and "effects" not in declared


def test_an_error_counts_without_and_with_that_of_the_diversity():
    one = judged(made(4.0, 2.0, 0), "plain")
    assert [one[key] for key in ("error_nm", "shape_nm", "defocus_nm", "strict_nm")] == [4.0, 4.0, 4.0, 5.0]
    assert len(SHAPES) == 27 and one["pull"] == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("error_nm", "pull", "bad"), [(11.0, 2.9, False), (13.0, 1.0, True), (1.0, 3.1, True)]
)
def test_bad_is_a_large_error_or_a_large_pull(error_nm, pull, bad):
    assert judged(made(error_nm, pull, 0), "plain")["bad"] is bad


def test_the_tables_count_lights_and_take_medians():
    some = [
        made(2.0, 1.0, 0, 0, True),
        made(4.0, 1.0, 4, 1, True),
        made(20.0, 1.0, 4, 2),
        made(30.0, 5.0, 0, 3),
    ]
    rows = cells(tables(some))
    assert rows["error of Noll 2–30, median"][1].startswith("12.0 nm")
    assert rows["error of Noll 2–30, median"][3].startswith("3.0 nm")
    assert rows["pull of Noll 4–30, RMS"][1].startswith(f"{np.sqrt(28 / 4):.2f}")
    assert rows["… where bad"][1].startswith("1 of 2") and rows["… where good"][1].startswith("1 of 2")
    assert rows["the light is right"][1].startswith("2 of 4")
    assert rows["0"][2:5] == ["2.0 → 2.0 nm", "1.0 → 1.0", "green → green"]


def test_intervals_of_a_median_hold_what_order_statistics_say():
    """Of 100 values the 95 % interval of the median reaches about from the 40th to the 61st."""
    low, high = interval(np.arange(1.0, 101.0), np.median)
    assert low == pytest.approx(40, abs=2) and high == pytest.approx(61, abs=2)


def test_what_is_kept_has_the_same_tables():
    some = [made(2.0, 1.0, 0, 0, True), made(4.0, 1.0, 4, 1)]
    some[0]["truth"]["mean_nm"] = {"4": 0.0, "31": 9.0}
    kept = [slim(one) for one in some]
    assert tables(kept) == tables(some)
    assert kept[0]["truth"]["mean_nm"] == {"4": 0.0}


@pytest.mark.slow
def test_a_draw_is_simulated_calibrated_and_kept(tmp_path):
    outcome = SUITE.work(SMALL, tmp_path)
    scene, static_nm = SMALL.planned(tmp_path / "spec.yaml").scene, outcome["truth"]["static_nm"]
    effects = scene.effects
    filter_nm, missed_nm = effects["filter_ncpa"]["zernike_nm"], effects["diversity_error"]["nm"]
    assert static_nm["6"] == pytest.approx(scene.ncpa_nm[6] + filter_nm[6] - missed_nm)
    assert outcome["truth"]["diversity_error_nm"]["6"] == pytest.approx(-missed_nm)
    one = judged(outcome, "plain")
    assert one["error_nm"] < np.linalg.norm([static_nm[str(noll)] for noll in REPORTED_NOLLS]) / 2
    assert one["red"] == bool(outcome["plain"]["failed"])


# -- pulls -------------------------------------------------------------------------------------


def pulled(index: int, pull: float) -> dict:
    """A cube and a ramp whose errors have one pull."""
    case = pulls.Case(1, index, 20)
    cube = {"error_nm": [2 * pull, -pull], "sigma_nm": [2.0, 1.0], "chi2": 2 * pull**2}
    ramp = {"error_nm": [3 * pull] * 2, "sigma_nm": [3.0] * 2, "photon_nm": [0.0] * 2, "instant_nm": 0.0}
    ramp["optics_nm"] = [3.0, 3.0]
    return {"seeing_arcsec": case.seeing_arcsec, "shape": case.shape, "cube": cube, "ramp": ramp}


def test_pulls_are_quadratic_means_by_group_and_of_all():
    text = pulls.table([pulled(0, 1.0), pulled(1, 2.0)])
    rows = {
        line.split("|")[2].strip(): [c.strip() for c in line.split("|")] for line in text.splitlines()[2:]
    }
    assert rows["0.35″"][5].startswith("1.00") and rows["0.5″"][5].startswith("2.00")
    everything = rows["**all**"]
    assert everything[1] == "2" and everything[5].startswith(f"{np.sqrt(2.5):.2f} (1.00–2.00)")
    assert everything[6] == "2.50" and everything[9].startswith("1.58")
    assert everything[10] == f"{np.sqrt((1 + 4) / 2):.2f}"
