"""The measured single image of NIRC2, where it is at hand."""

from __future__ import annotations

import json

import numpy as np
import pytest
from helpers.paths import RECIPES, SHARED

from irlos_pipe.pipeline import run_recipe
from irlos_pipe.product.storage import read_product
from irlos_pipe.recipe.load import load_recipe

RECIPE = RECIPES / "measured" / "nirc2.yaml"
IMAGE = SHARED / "realdata" / "keck_nirc2" / "20130801_n0004.fits"
HALF_PX = 24  # of the square about the peak in which model and image are compared


@pytest.mark.slow
@pytest.mark.measured
@pytest.mark.skipif(not IMAGE.is_file(), reason="the measured image is not there")
def test_the_model_explains_one_image_to_2_5_percent(tmp_path):
    run_recipe(load_recipe(RECIPE, (), [f"cube={IMAGE}"]), tmp_path)
    stages = json.loads((tmp_path / "results.json").read_text())["stages"]
    assert stages["calibrate"]["errors_from"] == "noise"
    arrays = read_product(tmp_path / "02_calibrate.h5").arrays
    measured, model = (arrays[name].value for name in ("mean_image_e", "model_image_e"))
    row, column = np.unravel_index(measured.argmax(), measured.shape)
    near = np.s_[row - HALF_PX : row + HALF_PX + 1, column - HALF_PX : column + HALF_PX + 1]
    residual = np.linalg.norm((measured - model)[near]) / np.linalg.norm(measured[near])
    assert residual < 0.025


def test_the_recipe_is_complete_but_for_its_data(tmp_path):
    recipe = load_recipe(RECIPE, (), [f"cube={tmp_path}"])
    assert recipe.instrument.pupil.diameter_m == 10.95
