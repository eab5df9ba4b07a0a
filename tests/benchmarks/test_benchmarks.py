"""The baselines of the benchmark image the same star as the model that they are compared with."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.baseline_fft import FftModel
from benchmarks.baseline_numpy_lift import NumpyLift
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


def test_the_numpy_lift_finds_the_coefficients_of_its_own_image(settings):
    fitter = NumpyLift(settings, (2, 3, 4), read_noise_e=1.0)
    truth_nm = np.array([20.0, -30.0, 60.0])
    found_nm = fitter.fit_nm(1e6 * fitter.images(truth_nm)[0])
    assert np.abs(found_nm - truth_nm).max() < 0.5
