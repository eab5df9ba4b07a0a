"""Every effect of the catalogue, switched on in a spec, reaches the frames and the truth, not the side-car.

Expected: the same recording without the effect, of the same seed. How large an effect is, the tests of
the simulator check.
"""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from astropy.io import fits
from helpers.simulation_specs import CUBE, simulated, spec_of, truth

from irlos_pipe.simulate.effects import EFFECTS

SIZES = {
    "tip_tilt_jitter": {"sigma_mas": 8},
    "vibration": {"sigma_mas": 8, "angle_deg": 70, "frequency_hz": 48.3, "shape": "gaussian"},
    "seeing_halo": {"wfe_nm": 90},
    "uneven_residual": {"edge": 0.4},
    "atmospheric_dispersion": {"mas_per_um": 300, "angle_deg": 45},
    "spectrum": {"wavelength_nm": 1630, "slope": 0.5},
    "plate_scale": {"fraction": 0.02},
    "anamorphism": {"fraction": 0.02, "angle_deg": 30},
    "diversity_error": {"nm": 20},
    "pupil_misregistration": {"dx_m": 0.1, "rotation_deg": 2.0},
    "pupil_geometry": {"obscuration_m": 1.3},
    "amplitude_aberration": {"zernike": {4: 0.1}},
    "pupil_spot": {"opacity": 0.9, "x_m": 2.0, "y_m": -1.0, "radius_m": 0.6},
    "low_wind_effect": {"piston_nm": [70, -70, 50, -30]},
    "segment_piston": {"piston_nm": [50, -40, 30, -20]},
    "high_order_ncpa": {"zernike_nm": {60: 40}},
    "phase_bump": {"nm": 150, "x_m": 1.5, "y_m": -1.0, "width_m": 0.8},
    "ncpa_drift": {"zernike_nm": {4: 80}},
    "chromatic_ncpa": {"zernike_nm_per_um": {7: 400}, "reference_nm": 1500},
    "filter_ncpa": {"zernike_nm": {7: 40}},
    "companion": {"flux_ratio": 0.05, "sep_mas": 60, "pa_deg": 30},
    "ghost": {"flux_ratio": 0.05, "sep_mas": 60, "pa_deg": 30, "defocus_nm": 50},
    "interpixel_crosstalk": {"fraction": 0.05},
    "detector_nonlinearity": {"fraction_at_peak": 0.05},
    "background_gradient": {"e_per_pixel": 5.0, "angle_deg": 30},
    "correlated_noise": {"e_rms": 100.0},
    "bad_pixels": [[3, 4], [15, 7]],
    "focus_stage_hysteresis": {"nm": 40},
    "focus_stage_offset": {"nm": 40},
    "focus_stage_scale": {"fraction": 0.2},
    "high_aperture": {"sine": 0.85},
}
FINE = {"pupil_samples": 64, "points_per_band": 3}
BRIGHT = {"mag_j": 6.0, "detector": {"e_per_adu": 5.0, "read_noise_e": 2.0}}
ONE = CUBE | BRIGHT | {"introduced_nm": 150.0, "sampling": FINE}


def recording(folder, effects: dict) -> tuple[np.ndarray, dict, dict]:
    """Mean image [ADU], side-car and truth of a recording without sky."""
    simulated(folder, spec_of({"one": ONE | {"effects": effects}}))
    data = folder / "data" / "one"
    table = fits.getdata(data / "one.fits", "IRPixelFrame")
    image = table["Pixels"].reshape(-1, 24, 24).mean(axis=0)
    return image, yaml.safe_load((data / "acquisition.yaml").read_text()), truth(folder, "one")


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return recording(tmp_path_factory.mktemp("plain") / "out", {})


@pytest.mark.slow
@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_changes_the_frames_and_is_told_in_the_truth_alone(tmp_path, plain, name):
    image, side_car, told = recording(tmp_path / "out", {name: SIZES[name]})
    noise_adu = np.sqrt(2 * ((plain[0] - 200) * 5 + 4) / 3) / 5
    assert np.abs((image - plain[0]) / noise_adu).max() > 8
    assert side_car == plain[1]
    assert list(told["hidden"]) == [name] and plain[2]["hidden"] == {}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["diversity_error", "focus_stage_offset", "high_order_ncpa", "phase_bump"])
def test_errors_of_the_wavefront_are_part_of_the_true_one(tmp_path, plain, name):
    told = recording(tmp_path / "out", {name: SIZES[name]})[2]
    modes = set(told["mean_zernike_nm"])
    changed = {
        noll for noll in modes if abs(told["mean_zernike_nm"][noll] - plain[2]["mean_zernike_nm"][noll]) > 1
    }
    # Modes beyond Noll 31 are in the wavefront, but are none of those that the file lists.
    own = {"diversity_error": {"6"}, "focus_stage_offset": {"4"}, "high_order_ncpa": set()}
    only = own.get(name, modes)
    assert changed <= only and bool(changed) == bool(only)
    stated = {noll for noll, value in told["ncpa_nm"].items() if value != plain[2]["ncpa_nm"].get(noll, 0.0)}
    assert stated == {"diversity_error": {"6"}, "high_order_ncpa": {"60"}}.get(name, set())
