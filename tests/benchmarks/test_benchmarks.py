"""The baselines of the benchmark image the same star as the model that they are compared with."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest
import torch

from benchmarks.baseline_fft import FftModel
from benchmarks.baseline_numpy_lift import NumpyLift
from benchmarks.focus_export import Fitted
from benchmarks.focus_latency import NOISE, WINDOW, compare, histogram, prepared
from benchmarks.inputs import reduction
from irlos_pipe.estimate.focus.sensor import Focus
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings

NOLLS = (2, 3, 4, 5, 7)
ZERNIKE_NM = torch.tensor([[40.0, -60.0, 120.0, 30.0, -50.0]])
DIVERSITY_NM = {6: -170.0}
SCALE_MAS, WINDOW_PX, WAVELENGTH_NM = 9.7, 64, 1600.0
FINE = 3  # samples per pixel and axis that stand for the pixel's area


@pytest.fixture(scope="module")
def settings():
    return PsfSettings(
        load_instrument("irlos").pupil,
        (WINDOW_PX, WINDOW_PX),
        SCALE_MAS,
        ((WAVELENGTH_NM, 1.0),),
        KnownWavefront(DIVERSITY_NM),
    )


def fft_model(settings, refinement=1):
    return FftModel(
        settings.geometry, NOLLS, DIVERSITY_NM, WAVELENGTH_NM, SCALE_MAS / refinement, WINDOW_PX * refinement
    )


@pytest.mark.slow
def test_the_fft_baseline_agrees_with_the_model_once_its_samples_are_pixels(settings):
    ours = PsfModel(settings, NOLLS).images(ZERNIKE_NM)[0]
    fine = fft_model(settings, FINE).images(ZERNIKE_NM)[0]
    theirs = fine.reshape(WINDOW_PX, FINE, WINDOW_PX, FINE).sum((1, 3))
    assert (ours - theirs).abs().max() < 0.01 * ours.max()


@pytest.mark.slow
def test_solvephase_finds_the_coefficients_of_the_models_image(settings):
    pytest.importorskip("solvephase", reason="a development dependency")
    from benchmarks.baseline_solvephase import SolvephaseFit

    image_e = (
        1e5
        * PsfModel(settings, range(2, 8)).images(torch.tensor([[40.0, -60.0, 120.0, 30.0, 0.0, -50.0]]))[0]
    )
    found_nm = SolvephaseFit(settings, 6, read_noise_e=1.0, loss="gaussian").fit_nm(image_e.numpy())
    assert found_nm == pytest.approx([40.0, -60.0, 120.0, 30.0, 0.0, -50.0], abs=2.0)


def test_the_numpy_lift_images_the_same_star_as_the_fft_baseline(settings):
    image, _ = NumpyLift(settings, NOLLS, read_noise_e=1.0).images(ZERNIKE_NM[0].numpy())
    theirs = fft_model(settings).images(ZERNIKE_NM)[0].numpy()
    assert image == pytest.approx(theirs, abs=1e-5 * float(theirs.max()))


def test_the_numpy_lift_finds_the_coefficients_of_its_own_image(settings):
    fitter = NumpyLift(settings, (2, 3, 4), read_noise_e=1.0)
    truth_nm = np.array([20.0, -30.0, 60.0])
    found_nm = fitter.fit_nm(1e6 * fitter.images(truth_nm)[0])
    assert np.abs(found_nm - truth_nm).max() < 0.5


def test_the_latency_of_the_focus_sensor_is_timed_beside_that_of_lift_on_the_same_images():
    focus, single = compare(3)
    assert (len(focus.wall_ms), len(single.wall_ms)) == (3, 10)
    assert sum(int(line.split("ms")[1].split()[0]) for line in histogram(focus.cpu_ms)) == 3


def test_what_is_exported_for_comparison_measures_the_same_focus():
    model, images_e = prepared()
    sensor = Focus(model, np.ones(WINDOW, bool), NOISE)
    fit = Fitted(sensor).eval()
    for image_e in images_e[:5]:
        focus_nm, sigma_nm, _ = fit(torch.as_tensor(image_e, dtype=torch.float32)).tolist()
        expected_nm, expected_sigma_nm, valid = sensor.measure(image_e)
        assert valid
        assert (focus_nm - expected_nm, sigma_nm) == pytest.approx((0, expected_sigma_nm), rel=1e-3, abs=5e-3)


@pytest.mark.slow
def test_the_reduction_that_the_benchmark_begins_with_is_one_that_the_program_accepts(tmp_path):
    command = [*reduction(tmp_path / "run"), "--dry-run"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
