"""The second start of a fit that ended in a wrong minimum. Truth: coefficients that frames were drawn with
from the model (same code, on purpose: what is tested is the way to the minimum)."""

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.pupil_steps import LowWindEffect
from irlos_pipe.estimate import cube_fit
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.methods import MeanImage, start_at_centroids
from irlos_pipe.estimate.starts import median_of_frames_nm
from irlos_pipe.numerics.solution import CONVERGED, Solution
from irlos_pipe.optics.psf import PsfModel

NOLLS, WINDOW, FLUX_E = tuple(range(2, 16)), 40, 1e6


@pytest.fixture(scope="module")
def truth_nm() -> torch.Tensor:
    return cases.vector(cases.ncpa_nm(4, highest_noll=15, total_nm=100.0), NOLLS)


@pytest.fixture(scope="module")
def frames(truth_nm) -> Frames:
    image = PsfModel(cases.settings(WINDOW), NOLLS).images(truth_nm)[0].double().numpy()
    images = cases.draw_frames(image * FLUX_E, 24, seed=2)
    return Frames(images, cases.everything(images), cases.READ_NOISE)


def solution(objective: float, status: str = CONVERGED) -> Solution:
    zero = torch.zeros(1, 1)
    return Solution(zero, zero[None], [status], torch.ones(1), torch.tensor([objective]))


def test_the_median_of_a_few_frames_is_near_the_truth(frames, truth_nm):
    model = PsfModel(cases.settings(WINDOW), NOLLS)
    found = median_of_frames_nm(model, frames.images_e, frames.good, frames.noise)
    assert (found - truth_nm[0]).norm() < 5


@pytest.mark.slow
def test_a_fit_that_ended_wrong_is_tried_again(frames, truth_nm, monkeypatch):
    def far_off(scheme, frames, problem):
        start = start_at_centroids(frames, problem)
        start[0, 5:9] = torch.tensor([600.0, -500.0, 500.0, 400.0], dtype=torch.float64)  # coma
        return start

    monkeypatch.setattr(MeanImage, "start", far_off)
    options = CalibrationOptions(highest_noll=15)
    found = calibrate(frames, cases.settings(WINDOW), options)
    assert np.linalg.norm(found.zernike_nm - truth_nm[0].numpy()) < 2
    assert found.chi2_nu < 1.2
    monkeypatch.setattr(cube_fit, "is_plausible", lambda problem, solution, most: True)
    once = calibrate(frames, cases.settings(WINDOW), options)
    assert once.chi2_nu > 10


PISTONS_NM = np.array([515.0, -585.0, 154.0, -84.0])
BROAD = tuple((wavelength_nm, 1.0) for wavelength_nm in (1150.0, 1300.0, 1500.0, 1600.0, 1750.0))


@pytest.fixture(scope="module")
def frames_of_petals(truth_nm) -> Frames:
    """In J+H, with petals of the pupil so far apart that waves of the two bands count differently."""
    model = ImageModel(PsfModel(cases.settings(WINDOW, BROAD), NOLLS), [LowWindEffect()])
    values = torch.tensor(LowWindEffect().values_of(piston_nm=PISTONS_NM, tip_nm=[0] * 4, tilt_nm=[0] * 4))
    flux, background = torch.tensor([FLUX_E]), torch.zeros(1)
    images = cases.draw_frames(model.predict(truth_nm, flux, background, values)[0].numpy(), 24, seed=3)
    return Frames(images, cases.everything(images), cases.READ_NOISE)


def petals_nm(frames: Frames) -> np.ndarray:
    """Pistons that a calibration finds, from their mean, whose absolute value no image shows."""
    options = CalibrationOptions(highest_noll=NOLLS[-1], prior=cases.PRIOR)
    found = calibrate(frames, cases.settings(WINDOW, BROAD), options, [LowWindEffect()])
    pistons = np.array(found.effects["low_wind_effect"]["piston_nm"])
    return pistons - pistons.mean()


@pytest.mark.long
def test_a_petal_that_a_fit_left_a_wave_off_is_brought_back(frames_of_petals, monkeypatch):
    expected = PISTONS_NM - PISTONS_NM.mean()
    assert np.abs(petals_nm(frames_of_petals) - expected).max() < 3
    monkeypatch.setattr(cube_fit, "a_wave_off", lambda *_: [])
    assert np.abs(petals_nm(frames_of_petals) - expected).max() > 500
