"""A wavefront of the ramp's own light: when it is tried, when it is kept, and what it is made of.

Truth: recordings, fits and qualities written down by hand; images of the simulator, which shares no optics
with the model, through another lens than that of the calibration.
"""

import json
import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import optics_cases as cases
from helpers import sparta_files
from helpers.effect_cases import BAND, RESIDUAL_LAW
from helpers.simulated_scenes import image

from irlos_pipe.effects.declaration import Conditions
from irlos_pipe.effects.motion import TipTiltJitter
from irlos_pipe.pipeline import run_recipe
from irlos_pipe.product.product import Product
from irlos_pipe.recipe import load_recipe
from irlos_pipe.stages.correct import angles_text
from irlos_pipe.stages.lift.input import (
    has_other_light,
    older_text,
    turned_text,
    with_own_wavefront,
)
from irlos_pipe.stages.lift.stage import Config


def context(config: Config | None = None, wavelength_nm: float = 1600.0, source: str = "lens"):
    inputs = [
        {
            "name": "cube",
            "input": "cubes",
            "observed": {"diversity_source": source, "derotator_angle_deg": 0.0},
        },
        {"name": "ramp", "input": "ramp", "observed": {"diversity_source": "lens"}},
    ]
    products = {
        "ingest": Product("ingest", {}, {"inputs": inputs}),
        "calibrate": Product("calibrate", {}, {"wavelength_nm": wavelength_nm}, config={"input": "cubes"}),
    }
    return SimpleNamespace(config=config or Config(), products=products, log=logging.getLogger("own"))


def ramp(wavelength_nm: float = 1600.0):
    return SimpleNamespace(acquisition=SimpleNamespace(wavelength_nm=wavelength_nm, diversity_source="lens"))


@pytest.mark.parametrize(
    ("ctx", "wavelength_nm", "other"),
    [
        (context(), 1600.0, False),
        (context(), 1420.0, True),
        (context(source="mirror"), 1600.0, True),
        (context(Config(calibrated=False)), 1420.0, False),
        (context(Config(common_modes=(5, 6))), 1420.0, False),
        (context(Config(singly=True)), 1420.0, False),
    ],
)
def test_the_light_is_another_one_by_its_wavelength_or_its_lens(ctx, wavelength_nm, other):
    assert has_other_light(ctx, ramp(wavelength_nm).acquisition) is other


@pytest.mark.parametrize(("own_deg", "named"), [(0.0, False), (360.0, False), (90.0, True)])
def test_a_calibration_at_another_angle_of_the_derotator_is_named(own_deg, named):
    taken = SimpleNamespace(derotator_angle_deg=own_deg)
    assert ("at 90° of the derotator, the calibration at 0°" in turned_text(context(), taken)) == named
    assert turned_text(context(Config(calibrated=False)), taken) == ""


@pytest.mark.parametrize(
    ("angles_deg", "there"),
    [((30.0,), ""), ((0.0, 360.0, -360.5), ""), ((90.0, 0.0), "0°, 90°"), ((5.0, 5.0, 25.0), "5°, 25°")],
)
def test_offsets_from_a_mean_over_angles_of_the_derotator_are_named(angles_deg, there):
    text = angles_text(angles_deg)
    assert f"mean over {there} of the derotator" in text if there else text == ""


@pytest.mark.parametrize(
    ("spectrum", "names"),
    [
        (((1215.0, 1.0), (1625.0, 1.0)), ["tip_tilt_jitter", "chromatic_ncpa", "filter_ncpa"]),
        (((1600.0, 1.0),), ["tip_tilt_jitter", "filter_ncpa"]),
    ],
)
def test_what_depends_on_wavelength_is_added_in_a_broad_band_alone(spectrum, names):
    conditions = Conditions(cases.settings(32, spectrum), BAND, RESIDUAL_LAW, 0.5, 30)
    found = with_own_wavefront([TipTiltJitter()], conditions)
    assert [effect.name for effect in found] == names


@pytest.mark.parametrize(("own_nm", "told"), [(40.0, True), (15.0, False)])
def test_a_wavefront_beyond_the_errors_says_that_the_calibration_is_of_another_time(own_nm, told):
    fit = SimpleNamespace(
        effects={"filter_ncpa": {"zernike_nm": {"5": own_nm}}},
        sigma={"filter_ncpa": {"zernike_nm": {"5": 3.0}}},
    )
    text = older_text(fit, 4.0)  # three times 5 nm are excused
    assert ("40 ± 5 nm RMS" in text and "not of this time" in text) is told
    assert older_text(SimpleNamespace(effects={}), 4.0) == ""


# -- the whole stage, on the bench -------------------------------------------------------------------

RECIPE = """\
recipe: own
inputs: {calibration: data/cube, ramp: data/ramp}
stages: [ingest, calibrate, lift]
model: {effects: []}
calibrate: {highest_noll: 15}
lift: {start: scan, compare: false}
"""
OFFSETS_NM = (-200.0, -100.0, 0.0, 100.0, 200.0)
NCPA_NM = {5: 40.0, 7: -30.0, 8: 25.0, 11: 20.0}
LENS_NM = {5: 25.0, 7: 25.0, 8: -20.0, 9: 20.0}
FLUX_E, WINDOW, FRAMES = 1e6, (48, 48), 3


def recorded(folder: Path, seed: int, keys: dict, **changes) -> None:
    """Photon noise of some frames, in electrons."""
    light = image(window=WINDOW, **changes) * FLUX_E
    frames = np.random.default_rng(seed).poisson(np.maximum(light, 0), (FRAMES, *WINDOW)).astype(float)
    told = {"pixel_scale_mas": 9.7, "detector": {"e_per_adu": 1.0, "read_noise_e": 0.5}}
    sparta_files.write_recorder(folder, frames, keys=told | keys)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("own")
    spectrum = [{"wavelength_nm": 1600.0, "weight": 1.0}]
    mirror = {"source": "mirror", "zernike": {6: 170.0}}
    keys = {"spectrum": spectrum, "diversity": mirror, "role": "ncpa_calibration"}
    recorded(folder / "data" / "cube", 1, keys, ncpa_nm=NCPA_NM, diversity_nm={6: 170.0})
    through = {noll: NCPA_NM.get(noll, 0.0) + LENS_NM.get(noll, 0.0) for noll in {*NCPA_NM, *LENS_NM}}
    lens = {"source": "lens", "zernike": {6: -170.0}}
    for number, offset in enumerate(OFFSETS_NM):
        keys = {
            "spectrum": spectrum,
            "diversity": lens,
            "role": "defocus_ramp",
            "introduced_defocus_nm": offset,
        }
        where = folder / "data" / "ramp" / f"offset_{number}"
        recorded(where, 2 + number, keys, ncpa_nm=through, introduced_nm=offset)
    (folder / "own.yaml").write_text(RECIPE)
    return folder


def lifted(folder: Path, mode: str) -> tuple[dict, str]:
    """Results and page; the second run finds its calibration done."""
    run_recipe(load_recipe(folder / "own.yaml", [f"lift.own_wavefront={mode}"]), folder / "out")
    results = json.loads((folder / "out" / "results.json").read_text())
    return results["stages"]["lift"], (folder / "out" / "report.html").read_text()


@pytest.mark.slow
def test_a_ramp_through_another_lens_shows_the_lens_and_errs_less(folder):
    (never, page), (auto, own_page) = lifted(folder, "never"), lifted(folder, "auto")
    assert "filter_ncpa" not in never["effects"]
    found = {int(noll): nm for noll, nm in auto["effects"]["filter_ncpa"]["zernike_nm"].items()}
    errors = [found[noll] - LENS_NM.get(noll, 0.0) for noll in range(5, 12) if noll != 6]
    assert np.abs(errors).max() < 3
    assert never["summary"]["rms_nm"] > 3 * auto["summary"]["rms_nm"]
    assert auto["summary"]["rms_nm"] < 2
    assert ["to which its own light adds" in one for one in (page, own_page)] == [False, True]
