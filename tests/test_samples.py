"""The whole reduction against known truth.

`data_samples/` was made with HCIPy by code that shares nothing with the model under test
(independent code); `../shared/samples`, where it exists, by a third simulator. The limits for
the latter are requirements; those for the former are twice the error to be expected from the scatter
between frames that the pipeline itself quotes and that these tests check.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import invoke

from irlos_pipe.pipeline import Resources, run_recipe
from irlos_pipe.recipe import load_recipe

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("samples")]  # long ones begin first

ROOT = Path(__file__).parents[1]
OWN, SHARED = ROOT / "data_samples", ROOT.parent / "shared" / "samples"
SHORT = ("mag_step=4", "realisations=2", "frames_per_offset=2")
needs_shared = pytest.mark.skipif(not SHARED.exists(), reason="the shared samples are not here")


def reduce(recipe: str, output: Path, settings=(), **inputs: Path) -> dict:
    """Results of a recipe, by stage."""
    given = [f"{name}={path}" for name, path in inputs.items()]
    loaded = load_recipe(ROOT / "recipes" / f"{recipe}.yaml", settings, given)
    run_recipe(loaded, output, resources=Resources(report=False))
    return json.loads((output / "results.json").read_text())["stages"]


def errors_nm(calibrate: dict, truth: Path) -> dict[int, float]:
    true = json.loads(truth.read_text())["mean_zernike_nm"]
    return {int(noll): value - true[noll] for noll, value in calibrate["zernike_nm"].items()}


def total(errors: dict[int, float]) -> float:
    return float(np.sqrt(sum(error**2 for error in errors.values())))


def test_the_demo_finds_the_ncpas_the_residual_and_the_ramp_of_the_own_sample(tmp_path):
    """All checks pass, and errors are within the scatter that is quoted."""
    settings = [word for one in SHORT for word in ("--set", f"sensitivity.{one}")]
    outcome = invoke("demo", "--output", str(tmp_path / "demo"), *settings, "--jobs", "1")
    assert outcome.exit_code == 0, outcome.output
    found = json.loads((tmp_path / "demo" / "results.json").read_text())["stages"]
    assert found.keys() >= {"ingest", "prior", "calibrate", "lift", "sensitivity"}
    errors = errors_nm(found["calibrate"], OWN / "truth" / "calibration-sky.json")
    quoted = np.sqrt(sum(sigma**2 for sigma in found["calibrate"]["sigma_nm"].values()))
    assert 1 < quoted < 8
    assert total(errors) < min(2 * quoted, 6)
    assert abs(errors[4]) < 3
    simulated = json.loads((OWN / "truth" / "calibration-sky.json").read_text())["simulation"]
    effects = found["calibrate"]["effects"]
    assert effects["tip_tilt_jitter"]["sigma_mas"] == pytest.approx(simulated["jitter_mas"], rel=0.1)
    assert effects["seeing_halo"]["wfe_nm"] == pytest.approx(simulated["residual_wfe_nm"], rel=0.05)
    summary, compare = found["lift"]["summary"], found["lift"]["compare"]
    assert abs(summary["slope"] - 1) < 0.015
    assert summary["rms_nm"] < 5
    assert compare["without AO residual"]["rms_nm"] > 2 * summary["rms_nm"]
    assert compare["without NCPAs"]["rms_nm"] > 5 * summary["rms_nm"]


@pytest.mark.long
def test_pixels_declared_1_percent_too_large_are_named_although_modes_imitate_them(tmp_path):
    settings = ["ingest.acquisition={pixel_scale_mas: 9.797}"]
    calibrate = reduce("ncpa_calibration", tmp_path, settings, calibration=OWN / "calibration-sky")[
        "calibrate"
    ]
    assert total(errors_nm(calibrate, OWN / "truth" / "calibration-sky.json")) > 10
    checks = json.loads((tmp_path / "qc.json").read_text())["checks"]
    (failed,) = [one for one in checks if not one["passed"]]
    assert "chi2" in failed["name"] and "9.7" in failed["message"]
    first = calibrate["causes"][0]
    assert first["name"] == "plate_scale" and first["explains"] > 0.5
    assert first["value"] == pytest.approx(9.7, abs=0.01)


@needs_shared
def test_ncpas_on_sky_are_within_10_nm_and_a_ramp_with_them_is_straight_to_5_nm(tmp_path):
    inputs = {"calibration": SHARED / "calibration-sky", "ramp": SHARED / "ramp-broad"}
    found = reduce("defocus_ramp", tmp_path, **inputs)
    errors = errors_nm(found["calibrate"], SHARED / "truth" / "calibration-sky.json")
    assert total(errors) < 10
    assert abs(errors[4]) < 3
    assert abs(found["lift"]["summary"]["slope"] - 1) < 0.015
    assert found["lift"]["summary"]["rms_nm"] < 5


@needs_shared
@pytest.mark.parametrize(
    "name", ["calibration-bench", pytest.param("calibration-odd-window", marks=pytest.mark.long)]
)
def test_a_noise_limited_cube_is_explained_down_to_the_noise(tmp_path, name):
    calibrate = reduce("ncpa_calibration", tmp_path, calibration=SHARED / name)["calibrate"]
    assert total(errors_nm(calibrate, SHARED / "truth" / f"{name}.json")) < 0.3
    assert 0.9 < calibrate["chi2_nu"] < 1.15


@needs_shared
def test_a_muse_raw_file_is_calibrated(tmp_path):
    name = "MUSE.2023-07-14T03:21:10.000"
    calibrate = reduce("ncpa_calibration", tmp_path, calibration=SHARED / f"{name}.fits")["calibrate"]
    truth = json.loads((SHARED / "truth" / f"{name}.json").read_text())
    true = truth.get("mean_zernike_nm", truth.get("ncpa_nm"))
    error = [value - true[noll] for noll, value in calibrate["zernike_nm"].items()]
    assert np.linalg.norm(error) < 10
