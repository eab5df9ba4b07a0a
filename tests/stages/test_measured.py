"""Measured recordings of other instruments, where they are at hand."""

import json

import numpy as np
import pytest
from helpers.paths import RECIPES, SHARED

from irlos_pipe.pipeline import run_recipe
from irlos_pipe.product.storage import read_product
from irlos_pipe.recipe.load import load_recipe

MEASURED = RECIPES / "measured"
DATA = SHARED / "realdata"
IMAGE = DATA / "keck_nirc2" / "20130801_n0004.fits"
RECORDING = DATA / "palomar_pharo" / "ca1.fits"


def measured(path):
    """Marks of a test that reduces what lies at `path`."""
    return lambda test: pytest.mark.slow(
        pytest.mark.measured(pytest.mark.skipif(not path.is_file(), reason=f"{path.name} is not there")(test))
    )


@pytest.mark.parametrize(
    ("name", "data", "diameter_m"),
    [
        ("beads", "ramp", 2 * 0.85),
        ("mirror_bead", "calibration", 2 * 1.2),
        ("nirc2", "cube", 10.95),
        ("pharo", "cube", 4.646),
    ],
)
def test_the_recipes_are_complete_but_for_their_data(tmp_path, name, data, diameter_m):
    recipe = load_recipe(MEASURED / f"{name}.yaml", (), [f"{data}={tmp_path}"])
    assert recipe.instrument.pupil.diameter_m == diameter_m


# -- a single image of NIRC2 -------------------------------------------------------------------------

HALF_PX = 24  # of the square about the peak in which model and image are compared


@measured(IMAGE)
def test_the_model_explains_one_image_to_2_5_percent(tmp_path):
    run_recipe(load_recipe(MEASURED / "nirc2.yaml", (), [f"cube={IMAGE}"]), tmp_path)
    stages = json.loads((tmp_path / "results.json").read_text())["stages"]
    assert stages["calibrate"]["errors_from"] == "noise"
    arrays = read_product(tmp_path / "02_calibrate.h5").arrays
    measured, model = (arrays[name].value for name in ("mean_image_e", "model_image_e"))
    row, column = np.unravel_index(measured.argmax(), measured.shape)
    near = np.s_[row - HALF_PX : row + HALF_PX + 1, column - HALF_PX : column + HALF_PX + 1]
    residual = np.linalg.norm((measured - model)[near]) / np.linalg.norm(measured[near])
    assert residual < 0.025


# -- a recording of PHARO ----------------------------------------------------------------------------

# What is expected was measured in other recordings of the same camera: a second image of 2.1 % at 492 to 495
# mas, position angle 219 to 220 deg. The vanes are documented as turned by about 2 deg; the sense is not.

TURNED_DEG = {"as in the profile": 0.0, "in the other sense": -4.0}
SECOND_IMAGE = {"sep_mas": (493.5, 1.5), "pa_deg": (219.5, 0.5), "flux_ratio": (0.021, 0.001)}
SURE = 3.0  # standard errors


@pytest.fixture(scope="module")
def diagnoses(tmp_path_factory) -> dict[str, dict]:
    """Results of the recipe, the pupil told in either sense."""
    found = {}
    for name, turned_deg in TURNED_DEG.items():
        folder = tmp_path_factory.mktemp("pharo")
        settings = [f"ingest.acquisition.pupil_rotation_deg={turned_deg}"]
        run_recipe(load_recipe(MEASURED / "pharo.yaml", settings, [f"cube={RECORDING}"]), folder)
        found[name] = json.loads((folder / "results.json").read_text())["stages"]["diagnose"]
    return found


@measured(RECORDING)
@pytest.mark.parametrize("told", TURNED_DEG)
def test_the_second_image_is_named_with_its_place_and_brightness(diagnoses, told):
    diagnosis = diagnoses[told]
    assert (diagnosis["verdict"], diagnosis["grade"]) == ("effect", "partial")
    (second,) = (step for step in diagnosis["steps"] if step["effect"] in ("companion", "ghost"))
    for key, (expected, sigma) in SECOND_IMAGE.items():
        both = np.hypot(second["sigma"][key], sigma)
        assert abs(second["parameters"][key] - expected) < SURE * both, key
