"""The second start of a fit that ended in a wrong minimum. Truth: coefficients that frames were drawn with
from the model (same code, on purpose: what is tested is the way to the minimum)."""

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases
from scipy.special import j1

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.pupil_steps import LowWindEffect
from irlos_pipe.estimate import methods
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames, steadied
from irlos_pipe.estimate.methods import MeanImage, start_at_centroids
from irlos_pipe.estimate.starts import median_of_frames_nm
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics.solver import CONVERGED, Solution
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
    found = median_of_frames_nm(model, frames)
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
    monkeypatch.setattr(methods.CubeFit, "_is_plausible", lambda *_: True)
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
    monkeypatch.setattr(methods, "a_wave_off", lambda *_: [])
    assert np.abs(petals_nm(frames_of_petals) - expected).max() > 500


# A star that moves between frames: an Airy pattern, displaced exactly, with photon noise.


SIDE, RESOLUTION_PX, READ_E = 40, 4.25, 5.0
DRIFT = np.linspace(-1, 1, 20)[:, None] * [4.0, -2.0]
NOISE = NoiseModel(1.0, READ_E**2)


def _airy(places_px: np.ndarray, flux_e: float, resolution_px: float = RESOLUTION_PX) -> np.ndarray:
    """Images of a round pupil at (x, y) from the window's centre, sampled at the pixels' centres."""
    axis = np.arange(SIDE) - (SIDE - 1) / 2
    x, y = (axis - places_px[:, k, None] for k in (0, 1))
    u = np.pi * np.hypot(x[:, None, :], y[:, :, None]) / resolution_px + 1e-9
    return flux_e * np.pi / (4 * resolution_px**2) * (2 * j1(u) / u) ** 2


def _steadied(places_px, flux_e=2e6, *, good=None, seed=1, noise=True, resolution_px=RESOLUTION_PX) -> Frames:
    rng = np.random.default_rng(seed)
    images = _airy(np.asarray(places_px, float), flux_e, resolution_px)
    if noise:
        images = rng.poisson(images) + rng.normal(0, READ_E, images.shape)
    good = np.ones((SIDE, SIDE), bool) if good is None else good
    still, seen, motion = steadied(images, good, NOISE, resolution_px)
    return Frames(torch.as_tensor(still), torch.as_tensor(seen), NOISE, motion=motion)


def _at_rest(found: Frames, places_px: np.ndarray, flux_e: float = 2e6) -> np.ndarray:
    """The true image of the star where the frames were steadied."""
    return _airy((places_px.mean(axis=0) + found.motion.rest_px)[None], flux_e)[0]


def test_a_drift_over_two_resolution_elements_is_taken_out_to_a_thousandth_of_the_peak():
    found = _steadied(DRIFT, noise=False)
    true, good = _at_rest(found, DRIFT), found.good.numpy()
    assert np.abs(found.mean_e.numpy() - true)[good].max() < 1e-3 * true.max()
    assert np.abs(found.motion.places_px - (DRIFT - DRIFT.mean(axis=0))).max() < 2e-3


def test_the_noise_of_the_mean_is_that_of_the_frames_at_rest():
    squares = []
    for seed in range(20):
        found = _steadied(DRIFT, seed=seed)
        whole = np.rint(DRIFT - DRIFT.mean(axis=0) - found.motion.rest_px)
        variance_e2 = (_airy(DRIFT - whole, 2e6).mean(axis=0) + READ_E**2) / len(DRIFT)
        pull = (found.mean_e.numpy() - _at_rest(found, DRIFT)) / np.sqrt(variance_e2)
        squares.append(np.mean(pull[found.good.numpy()] ** 2))
    assert 0.95 < np.mean(squares) < 1.15


@pytest.mark.parametrize(
    ("places", "course"),
    [
        (DRIFT, "drifts"),
        (np.repeat([[0.0, 0.0], [3.0, 0.0]], [12, 18], axis=0), "jumps after frame 12"),
        (np.tile([[-6.0, -6.0], [6.0, 6.0]], (10, 1)), "moves from frame to frame"),
        (np.random.default_rng(3).normal(0, 1.5, (20, 2)), "moves from frame to frame"),
    ],
)
def test_motion_is_measured_and_named(places, course):
    motion = _steadied(places).motion
    assert motion.course == course
    assert motion.largest_px == pytest.approx(np.ptp(places, axis=0).max(), abs=0.02)
    assert motion.rms_px == pytest.approx(places.std(axis=0).max(), abs=0.01)
    truth = places - places.mean(axis=0)
    assert np.std(motion.places_px - truth) == pytest.approx(motion.error_px, rel=0.3)


def test_pixels_that_most_frames_saw_beyond_the_edge_or_as_bad_are_masked():
    good = np.ones((SIDE, SIDE), bool)
    good[10, 12] = False
    found = _steadied(np.repeat([[0.0, 0.0], [3.0, 0.0]], 20, axis=0), good=good)
    bad = {tuple(pixel) for pixel in np.argwhere(~found.good.numpy()).tolist()}
    inner = {pixel for pixel in bad if 3 < pixel[1] < SIDE - 3}
    assert len(inner) == 2 and {row for row, _ in inner} == {10}
    assert np.ptp([column for _, column in inner]) == 3
    assert len(bad - inner) == 3 * SIDE
