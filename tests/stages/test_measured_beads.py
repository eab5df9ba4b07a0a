"""The measured focus ramp of a bead, where it is at hand. Truth: the documented travel of the stage."""

from __future__ import annotations

import json
import runpy

import pytest
from helpers.paths import RECIPES, SHARED

from irlos_pipe.pipeline import run_recipe
from irlos_pipe.recipe.load import load_recipe

MEASURED = RECIPES / "measured"
RAMP = SHARED / "realdata" / "npz" / "pyotf_focus_ramp.npz"
QUICK = ("model.effects=[tip_tilt_jitter]", "lift.common_modes=[6,7,8,11,16,22,37]")


@pytest.fixture(scope="module")
def stages(tmp_path_factory) -> dict:
    folder = tmp_path_factory.mktemp("beads")
    runpy.run_path(str(MEASURED / "beads_to_fits.py"))["main"](str(RAMP), str(folder))
    recipe = load_recipe(MEASURED / "beads.yaml", QUICK, [f"ramp={folder / 'beads.fits'}"])
    run_recipe(recipe, folder / "run")
    return json.loads((folder / "run" / "results.json").read_text())["stages"]


@pytest.mark.slow
@pytest.mark.measured
@pytest.mark.skipif(not RAMP.is_file(), reason="the measured ramp is not there")
def test_the_high_aperture_of_the_microscope_is_named(stages):
    first = stages["diagnose"]["steps"][0]
    assert (stages["diagnose"]["verdict"], first["effect"]) == ("effect", "high_aperture")
    assert first["gap_after"] < 0.85 * first["gap_before"]
    assert stages["ingest"]["inputs"][0]["frames_rejected"] == 0


def test_the_recipe_is_complete_but_for_its_data(tmp_path):
    recipe = load_recipe(MEASURED / "beads.yaml", (), [f"ramp={tmp_path}"])
    assert recipe.instrument.facility.numerical_aperture == 0.85
    assert recipe.instrument.pupil.diameter_m == 2 * 0.85
