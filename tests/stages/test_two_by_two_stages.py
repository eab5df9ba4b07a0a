"""A raw file of a 2x2 mode through ingest, calibrate and lift.

Truth: the wavefront in the images of the light path itself, with Poisson noise; they share its assumptions.
"""

import json

import numpy as np
import pytest
import torch
from helpers.sparta_files import TWO_BY_TWO, quadrants, write_muse

from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.lenslets import LensletArray, apart
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.pipeline import run_recipe
from irlos_pipe.recipe import load_recipe

TRUE_NM = {2: 15.0, 3: -10.0, 4: 70.0, 5: 25.0, 6: -30.0}
FRAMES, FLUX_E, E_PER_ADU = 10, 1e5, 9.8 / 68
SIDE_CAR = "spectrum: [{wavelength_nm: 1600}]\nmag_j: 9\nexposure_s: 0.1\nframe_rate_hz: 10\n"
RECIPE = """\
recipe: small
inputs: {{cube: "{path}", ramp: "{path}"}}
stages: [{stages}]
model: {{effects: [tip_tilt_jitter], pupil_samples: 64}}
{calibrate}
lift: {{input: cube, start: zero, compare: false}}
"""


def raw_file(folder):
    settings = PsfSettings(
        load_instrument("irlos").pupil, (36, 36), 78.0, ((1600.0, 1.0),), KnownWavefront(), 64, lenslets=2
    )
    model = LensletArray(settings.for_broad_images(), tuple(TRUE_NM), dtype=torch.float64)
    mean_e = FLUX_E * model.images(torch.tensor([[*TRUE_NM.values()]], dtype=torch.float64))
    rng = np.random.default_rng(5)
    noisy = rng.poisson(mean_e.clamp_min(0).repeat(FRAMES, 1, 1).numpy()) + rng.normal(0, 1, (FRAMES, 36, 36))
    adu = torch.as_tensor(np.rint(noisy / E_PER_ADU + 200))
    path = write_muse(folder / "m.fits", quadrants([part.numpy() for part in apart(adu)]), TWO_BY_TWO)
    (folder / "m.yaml").write_text(SIDE_CAR)
    return path


def run(folder, stages: str, *settings: str) -> dict:
    calibrate = "calibrate: {input: cube, highest_noll: 6}" if "calibrate" in stages else ""
    text = RECIPE.format(path=raw_file(folder), stages=stages, calibrate=calibrate)
    (folder / "r.yaml").write_text(text)
    run_recipe(load_recipe(folder / "r.yaml", settings), folder / "out")
    return json.loads((folder / "out" / "results.json").read_text())["stages"]


@pytest.mark.slow
def test_a_raw_file_gives_its_low_orders_what_it_determines_and_the_focus_of_every_frame(tmp_path):
    stages = run(tmp_path, "ingest, calibrate, lift")
    calibrate, lift = stages["calibrate"], stages["lift"]
    for noll, truth_nm in TRUE_NM.items():
        error_nm = calibrate["zernike_nm"][str(noll)] - truth_nm
        assert abs(error_nm) < 4 * calibrate["sigma_nm"][str(noll)] + 0.5
    lenslets = calibrate["lenslets"]
    assert {4, 5, 6} <= set(lenslets["determined"]) and lenslets["combinations"] >= 5
    assert lenslets["information"] == sorted(lenslets["information"], reverse=True)
    assert lenslets["centroids_nm"]["4"] == pytest.approx(TRUE_NM[4], rel=0.25)
    assert 0 < lenslets["bound_nm"]["4"] < 3
    assert len(lift["points"]) == FRAMES and lift["summary"]["slope"] is None
    errors_nm = np.array([point["zernike_nm"]["4"] for point in lift["points"]])  # beyond the calibrated
    assert np.abs(errors_nm).max() < 6 * np.median([point["sigma_photon_nm"] for point in lift["points"]])
