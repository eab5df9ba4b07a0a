"""The noise model. Truth: Monte Carlo with the detector of ``data_samples`` (independent code), analysis."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import integrate
from simulator.detector import Detector as SimulatedDetector

from irlos_pipe.frames.noise import ExposureNoise, NoiseModel
from irlos_pipe.frames.recording import Acquisition, Detector, Recording

LEVELS_E = np.array([0.0, 3.0, 40.0, 900.0, 20_000.0])


def recording(detector: Detector, background_variance_e2: float) -> Recording:
    acquisition = Acquisition("psf", detector, ((1600.0, 1.0),), {}, 9.7)
    empty = np.zeros((1, 2, 2), np.float32)
    zero = np.zeros(1)
    return Recording(
        "r",
        "cube",
        empty,
        zero == 0,
        zero.astype(str),
        empty[0] == 0,
        zero,
        zero,
        zero,
        acquisition,
        background_variance_e2,
    )


@pytest.mark.parametrize("excess", [1.0, 1.47])
def test_simulated_frames_scatter_as_the_model_says(excess):
    """Read noise counts once, as a variance: F x signal + sigma² within 1 %."""
    simulated = SimulatedDetector(e_per_adu=0.5, read_noise_e=3.0, excess_noise_factor=excess)
    rng = np.random.default_rng(1)
    mean_e = np.repeat(LEVELS_E, 100_000)[None]
    frame = simulated.read_out(mean_e, np.full(mean_e.shape, 500.0), 1.0, rng) * 0.5
    measured = frame.reshape(len(LEVELS_E), -1).var(1)
    noise = NoiseModel.of(recording(Detector(0.5, 3.0, excess), 0.0))
    assert noise.variance_e2(LEVELS_E) == pytest.approx(measured, rel=0.02)
    assert np.mean(noise.variance_e2(LEVELS_E) / measured) == pytest.approx(1, abs=0.01)


def half_deviance(noise: NoiseModel, seen_e: torch.Tensor, model_e: torch.Tensor) -> torch.Tensor:
    """How much less likely a model is than the data themselves."""
    return noise.minus_quasi_likelihood(seen_e, model_e) - noise.minus_quasi_likelihood(seen_e, seen_e)


@pytest.mark.parametrize("seen_e", [-7.0, 0.0, 3.0, 900.0])
@pytest.mark.parametrize("model_e", [-4.0, 0.0, 5.0, 800.0])
def test_the_deviance_is_the_integral_of_the_slope_of_least_squares(seen_e, model_e):
    noise = NoiseModel(1.4, 5.0, 2.0)
    expected, _ = integrate.quad(
        lambda t: (seen_e - t) / float(noise.variance_e2(np.float64(t))), model_e, seen_e, points=[0.0]
    )
    found = half_deviance(noise, *(torch.tensor([one], dtype=torch.float64) for one in (seen_e, model_e)))
    assert float(found) == pytest.approx(expected, rel=1e-8, abs=1e-9)


def test_without_read_noise_the_deviance_is_that_of_poisson_s_law():
    seen = torch.tensor([3.0, 40.0, 900.0], dtype=torch.float64)
    model = torch.tensor([5.0, 38.0, 1000.0], dtype=torch.float64)
    poisson = seen * (seen / model).log() - (seen - model)
    found = half_deviance(NoiseModel(1.0, 1e-9), seen, model)
    assert found.numpy() == pytest.approx(poisson.numpy(), rel=1e-6)


def test_reads_sky_and_dark_add_up_in_variance():
    noise = ExposureNoise(200, 1.0, 1.25, sky_e=14.0, dark_e=2.0)
    assert noise.floor_e2 == pytest.approx(200 + 1.25 * 16)
