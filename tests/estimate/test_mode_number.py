"""How many modes the frames support. Truth: frames drawn from the model with a known number of modes (same
code, on purpose: only the number of modes is in question), and the expectation of χ²."""

import numpy as np
import pytest
from helpers import optics_cases as cases

from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.mode_number import BLOCKS_PER_HALF, choose, halves, scan_mode_numbers
from irlos_pipe.optics.psf import PsfModel

FRAMES, FLUX, WINDOW = 48, 3e5, 40
NOLLS = tuple(range(2, 16))
NUMBERS = (6, 10, 15, 21, 28)


@pytest.fixture(scope="module")
def truth_nm() -> dict[int, float]:
    """Fourteen modes, the last five of 30 nm each."""
    return cases.ncpa_nm(4, highest_noll=10, total_nm=80.0) | dict.fromkeys(range(11, 16), 30.0)


@pytest.fixture(scope="module")
def scan(truth_nm):
    image = PsfModel(cases.settings(WINDOW), NOLLS).images(cases.vector(truth_nm, NOLLS))
    images = cases.draw_frames(image[0].double().numpy() * FLUX, FRAMES, seed=1)
    frames = Frames(images, cases.everything(images), cases.READ_NOISE)
    return scan_mode_numbers(frames, cases.settings(WINDOW), CalibrationOptions(), NUMBERS)


@pytest.mark.slow
def test_the_simulated_number_is_recommended(scan):
    choice = choose(scan.misfit)
    assert scan.highest_nolls[choice.recommended] == 15


@pytest.mark.slow
def test_unseen_frames_see_too_few_modes_and_too_many(scan):
    misfit = scan.misfit.mean(axis=1)
    assert misfit[0] > misfit[1] > misfit[2] + 0.1
    assert misfit[2] < misfit[3] < misfit[4]


@pytest.mark.slow
def test_halves_differ_as_their_mean_errs(scan, truth_nm):
    true = np.array([truth_nm.get(noll, 0.0) for noll in scan.nolls])
    error = np.linalg.norm(scan.mean_nm[2] - true)
    assert 0.5 < scan.halves_nm[2] / error < 2
    assert np.linalg.norm(scan.mean_nm[0] - true) > 10 * error


def test_halves_share_no_frame_and_alternate():
    one, other = halves(16 * BLOCKS_PER_HALF + 3)
    assert not set(one.ravel()) & set(other.ravel())
    assert one.shape == other.shape == (BLOCKS_PER_HALF, 8)
    assert np.all(one[:, 0] < other[:, 0]) and np.all(one[1:, 0] > other[:-1, 0])


def test_the_smallest_number_within_the_error_of_the_best_is_chosen():
    rng = np.random.default_rng(1)
    shared = rng.normal(size=16)  # what all numbers have in common falls out
    misfit = np.array([3.0, 1.0005, 1.0, 1.2])[:, None] + shared + 0.01 * rng.normal(size=(4, 16))
    choice = choose(misfit)
    assert choice.recommended == 1
    assert choice.excess_sigma[choice.best] == 0
    assert choice.excess[3] > 5 * choice.excess_sigma[3]
