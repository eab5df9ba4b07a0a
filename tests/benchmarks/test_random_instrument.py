"""The random instrument: what is drawn, how a calibration is judged, one draw to its end; and pulls.

Truth: the limits of the errors as the page states them; outcomes written down by hand.
"""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import pulls
from benchmarks.random_instrument import (
    SUITE,
    Case,
    all_cases,
    judged,
)
from irlos_pipe.conventions.modes import REPORTED_NOLLS

SPECS = [case.spec() for case in all_cases(1, 200, 0, 20)]
SMALL = Case(1, 0, 8, window=36)


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
