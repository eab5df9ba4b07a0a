"""Errors of the flat by Monte Carlo."""

import numpy as np
import pytest
import torch

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.diagnosis.checks import flat_rms
from irlos_pipe.diagnosis.cube import Stack
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings

SETTINGS = PsfSettings(PupilGeometry(8.0), (64, 64), 9.7, ((1600.0, 1.0),), KnownWavefront())


def cube(flat: float, seed: int) -> tuple[Stack, torch.Tensor]:
    """A broad image through a flat with an error, and what its mean differs by from the image."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:64, :64] - 31.5
    image = 200.0 + 2e4 * np.exp(-(x**2 + y**2) / 2 / 8.0**2)
    gain = 1 + flat * rng.standard_normal((64, 64))
    frames = rng.poisson(image * gain, size=(60, 64, 64)).astype(np.float32)
    noise = NoiseModel(1.0, 1.0)
    taken = Frames(torch.as_tensor(frames), torch.ones(64, 64, dtype=torch.bool), noise)
    stack = Stack.of(taken, np.linspace(0, 1, 60))
    smooth = 0.02 * image * np.cos(x / 8)  # an error of the model, which has nothing beyond the cut-off
    return stack, stack.mean_e - torch.as_tensor((image + smooth).ravel())


@pytest.mark.parametrize("flat", [0.002, 0.01])
def test_the_error_of_the_flat_is_measured_beside_a_smooth_misfit(flat):
    found = [flat_rms(*cube(flat, seed), SETTINGS) for seed in range(4)]
    assert np.mean(found) == pytest.approx(flat, rel=0.1)


def test_a_perfect_flat_shows_no_error():
    assert [flat_rms(*cube(0.0, seed), SETTINGS) for seed in range(4)] == [0.0] * 4
