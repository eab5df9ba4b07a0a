"""Simulated recordings of 2x2 modes: their files, and their images beside those of the model.

Simulator and model share no optics, but the idea of what a lenslet array does: a sharp quarter of the pupil
each, a common wavefront, no light between the field stops.
"""

import numpy as np
import pytest
import torch
from astropy.io import fits

from irlos_pipe.files.yaml import yaml_text
from irlos_pipe.optics.lenslets import LensletArray, apart, side_by_side
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.simulate.aperture import passed
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.recordings.run import simulate
from irlos_pipe.simulate.recordings.spec import load_spec, plan_recordings

MODES_NM = {2: 30.0, 3: -20.0, 4: 90.0, 5: 25.0, 6: -40.0, 8: 30.0}
RECORDING = {
    "role": "psf",
    "mode": "20x20_SmallScale_500Hz_HighGain",
    "mag_j": 9,
    "bands": [{"centre_nm": 1600, "half_width_nm": 0}],
    "frames": 2,
    "exposure_s": 0.002,
    "window": [20, 20],
    "start": "2020-07-14T03:21:10",
    "ncpa": {"zernike_nm": MODES_NM},
    "sampling": {"pupil_samples": 96},
}


def spec(tmp_path, **changes):
    path = tmp_path / "spec.yaml"
    path.write_text(yaml_text({"simulation": "s", "recordings": {"one": RECORDING | changes}}))
    return load_spec(path)


@pytest.mark.slow
def test_simulated_images_are_those_of_the_model(tmp_path):
    tilts = {"x_mas": [3.0, 0.0, 0.0, 0.0], "y_mas": [0.0, -2.0, 0.0, 0.0], "flux": [0.2, 0.0, 0.0, 0.0]}
    scene = plan_recordings(spec(tmp_path, lenslet_images=tilts))[0].scene
    image = expose(scene).mean_e[0] / scene.photons
    assert scene.pixel_scale_mas == 60.0  # the mode in 2020
    settings = PsfSettings(scene.geometry, (20, 20), 60.0, ((1600.0, 1.0),), KnownWavefront(), 96, lenslets=2)
    model = LensletArray(settings.for_broad_images(), tuple(MODES_NM), dtype=torch.float64)
    modes = torch.tensor([[*MODES_NM.values()]] * 3, dtype=torch.float64)
    modes[1, 0] += 3.0e-3 / 206265 * 8 * 1e9 / 4  # an angle θ is a tilt of θ D/4
    modes[2, 1] -= 2.0e-3 / 206265 * 8 * 1e9 / 4
    still, right, down = (apart(one) for one in model.images(modes))
    parts = [1.2 * right[0], down[1], still[2], still[3]]
    share = _light(scene.geometry)
    expected = side_by_side(parts).numpy() / (1 + 0.2 * share)
    assert np.abs(image - expected).max() < 1e-3 * expected.max()


def _light(geometry) -> float:
    """Share of the lower left quarter of the pupil, by counting points."""
    u = (np.arange(800) - 399.5) / 100
    clear = passed(geometry, u[None, :], u[:, None])
    return clear[:400, :400].sum() / clear.sum()


@pytest.mark.slow
def test_a_raw_file_has_quadrants_with_borders_and_perhaps_no_side_car(tmp_path):
    simulate(spec(tmp_path, side_car=False), tmp_path / "out")
    (path,) = (tmp_path / "out" / "data" / "one").iterdir()
    assert path.name == "MUSE.2020-07-14T03:21:10.000.fits"
    with fits.open(path) as hdus:
        cube = hdus["SPARTA_TT_CUBE"].data
        assert hdus[0].header["ESO AOS MAIN MODES IRLOS"] == RECORDING["mode"]
    apart = cube.reshape(2, 2, 12, 2, 12)
    inside = apart[:, :, 1:-1, :, 1:-1]
    assert inside.min() > 100 and cube.sum(dtype=int) == inside.sum(dtype=int)
