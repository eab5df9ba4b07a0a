"""A small simulated night from the recorder's files to pages and trend, by real recipes and processes.

Truth: coefficients that the simulation was given; the simulator shares no optics with the model.
"""

import json
from pathlib import Path

import pytest
from conftest import invoke
from helpers.paths import RECIPES
from helpers.simulation_specs import CUBE, RAMP, simulated, spec_of, written

from irlos_pipe.night.settings import BandSettings
from irlos_pipe.night.trend import read_trend

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("night")]  # its fixtures take long

TRUTH_NM = {4: 40.0, 7: -30.0, 11: 20.0}
SMALL = {
    "model.pupil_samples": 64,
    "model.effects": [],
    "calibrate.highest_noll": 11,
    "calibrate.max_chi2_nu": 1e9,
    "calibrate.min_window": 0.0,
}


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    """A calibration cube, a ramp with the same NCPAs, and a cube that is cut off."""
    folder = tmp_path_factory.mktemp("night")
    common = {"window": [32, 32], "detector": {"e_per_adu": 2.0}}
    cube = CUBE | common | {"frames": 4, "mag_j": 7.0}
    ramp = RAMP | common | {"mag_j": 9.5, "bands": "narrow_h"}
    recordings = {"cube": cube, "torn": cube, "ramp": ramp}
    simulated(folder / "sim", spec_of(recordings, ncpa={"zernike_nm": TRUTH_NM}))
    torn = folder / "sim/data/torn/torn.fits"
    torn.write_bytes(torn.read_bytes()[:9000])
    return folder / "sim/data"


@pytest.fixture(scope="module")
def config(tmp_path_factory) -> Path:
    ramp = SMALL | {"lift.compare": False, "lift.max_residual_nm": 1e4, "lift.max_chi2_ratio": 1e9}
    content = {
        "recipes": {
            "calibration": [str(RECIPES / "ncpa_calibration.yaml")],
            "ramp": [str(RECIPES / "defocus_ramp.yaml")],
        },
        "settings": {"ncpa_calibration": SMALL, "defocus_ramp": ramp},
    }
    return written(tmp_path_factory.mktemp("config") / "night.yaml", content)


@pytest.fixture(scope="module")
def night(archive, config, tmp_path_factory):
    """The tree, and what the command said."""
    tree = tmp_path_factory.mktemp("tree")
    return tree, invoke("night", str(archive), "--output", str(tree), "--config", str(config), "--jobs", "1")


def test_one_line_names_the_bad_recording_and_the_rest_is_reduced(night):
    tree, result = night
    page = tree / "night_2024-02-10.html"
    assert result.exit_code == 5 and result.stdout == "" and result.stderr.count("\n") == 1
    assert "torn.fits" in result.stderr and str(page) in result.stderr
    results = {path.parent.name: json.loads(path.read_text()) for path in tree.glob("*/*/[!.]*/results.json")}
    statuses = {name: one["status"] for name, one in results.items()}
    assert statuses == {"ncpa_calibration": "ok", "defocus_ramp": "ok"}


def test_the_trend_holds_the_ncpas_that_were_put_in(night):
    tree, _ = night
    found = {one.name: one.points[0] for one in read_trend(tree, BandSettings()).series}
    for noll, truth_nm in TRUTH_NM.items():
        point = found[f"noll_{noll}_nm"]
        assert abs(point.value - truth_nm) < 3 and 0 < point.sigma < 3
    assert abs(found["defocus_bias_nm"].value) < 5 and abs(found["ramp_slope"].value - 1) < 0.05
