"""Dimming frames and the limiting magnitude. Truth: Monte Carlo of really faint stars, and analysis."""

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.ramp_fit import RampData
from irlos_pipe.estimate.sensitivity import (
    MEDIAN_OF_NORMAL,
    Configuration,
    Criterion,
    dim,
    limiting_magnitude,
    scan,
)
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf import PsfModel

pytestmark = pytest.mark.slow
NOISE = NoiseModel(1.4, 9.0)
FRAMES = 4000


@pytest.fixture(scope="module")
def bright_image() -> np.ndarray:
    model = PsfModel(cases.settings(24), [2])
    return model.images(torch.zeros(1, 1))[0].double().numpy() * 2e5


@pytest.mark.parametrize("factor", [0.6, 0.05])
def test_dimmed_frames_have_mean_and_variance_of_a_faint_star(bright_image, factor):
    frames = cases.draw_frames(bright_image, FRAMES, seed=1, noise=NOISE)
    signal = torch.as_tensor(bright_image).expand(FRAMES, -1, -1)
    dimmed = dim(frames, signal, factor, NOISE, torch.Generator().manual_seed(2)).numpy()
    expected = NOISE.variance_e2(factor * bright_image)
    assert abs(dimmed.mean(0).sum() / (factor * bright_image.sum()) - 1) < 2e-3
    assert abs(dimmed.var(0).sum() / expected.sum() - 1) < 0.01
    assert abs(np.mean(dimmed.var(0) / expected) - 1) < 0.01


def test_dimmed_frames_can_have_the_noise_of_many_reads(bright_image):
    frames = cases.draw_frames(bright_image, FRAMES, seed=1, noise=NOISE)
    signal, many = torch.as_tensor(bright_image).expand(FRAMES, -1, -1), NoiseModel(1.5, 200.0)
    dimmed = dim(frames, signal, 0.1, NOISE, torch.Generator().manual_seed(3), many).numpy()
    expected = many.variance_e2(0.1 * bright_image)
    assert abs(dimmed.mean(0).sum() / (0.1 * bright_image.sum()) - 1) < 5e-3
    assert abs(np.mean(dimmed.var(0) / expected) - 1) < 0.01


CRITERION = Criterion(median_nm=20.0, failure_fraction=0.1)
MAGNITUDES = np.array([12.0, 14.0, 16.0, 18.0])


@pytest.mark.parametrize(
    ("median_nm", "failures", "limit"),
    [
        (2.0 * 10 ** (0.4 * (MAGNITUDES - 12)), np.zeros(4), 14.5),  # 20 nm at 12 + 2.5, in the logarithm
        (np.full(4, 5.0), np.array([0, 0, 0.3, 0.9]), 14.0),  # failures stop it at the last good magnitude
        (np.full(4, 50.0), np.zeros(4), np.nan),
        (np.full(4, 5.0), np.zeros(4), 18.0),  # the end of the grid
    ],
)
def test_the_limit_is_where_errors_or_failures_exceed_the_criterion(median_nm, failures, limit):
    found = limiting_magnitude(MAGNITUDES, median_nm, failures, CRITERION)
    assert found == pytest.approx(limit, nan_ok=True)


def test_a_scan_reaches_the_bound_where_frames_err_by_noise_alone():
    """Monte Carlo: noisy frames of the model itself, so that the error is that of an efficient estimate."""
    model = PsfModel(cases.settings(24), [2, 3, 4])
    introduced = np.linspace(-60, 60, 8)
    true = torch.zeros(8, 3, dtype=torch.float64)
    true[:, 2] = torch.as_tensor(introduced)
    signal = model.images(true).double() * 2e6
    frames = torch.cat([cases.draw_frames(mean.numpy(), 1, seed) for seed, mean in enumerate(signal)])
    (curve,) = scan(
        [Configuration(ImageModel(model), signal, true)],
        RampData(frames, cases.everything(frames), cases.READ_NOISE, introduced),
        10.0,
        np.array([12.5, 15.0]),
        20,
        Criterion(30.0, 0.1),
        seed=5,
    )
    assert curve.abs_error_nm.shape == (2, 160)
    # relative error of a median of 160 absolute normal values: 1.17 / sqrt(160) = 9 %
    assert curve.median_abs_error_nm == pytest.approx(MEDIAN_OF_NORMAL * curve.crb_nm, rel=0.25)
    assert curve.failures.tolist() == [0, 0]
