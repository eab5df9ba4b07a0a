"""Mixtures of two kinds of frames, against Gaussian scatter and a vibration."""

import numpy as np
import torch

from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.residual import kurtosis_of_frames
from irlos_pipe.frames.noise import NoiseModel

SIDE, COUNT = 12, 40


def _kurtosis(strength: np.ndarray) -> float:
    """Of frames of photon noise with one pattern of the given strength in every frame."""
    rng = np.random.default_rng(1)
    pattern = rng.normal(size=(SIDE, SIDE))
    images = rng.poisson(100.0, (len(strength), SIDE, SIDE)) + strength[:, None, None] * pattern
    good = torch.ones(SIDE, SIDE, dtype=torch.bool)
    return kurtosis_of_frames(Frames(torch.as_tensor(images), good, NoiseModel(1.0, 1.0)))


def test_two_kinds_of_frames_sit_at_two_values():
    assert _kurtosis(np.tile([50.0, -50.0], COUNT // 2)) < 1.1
    assert _kurtosis(np.repeat([50.0, -50.0], [16, 24])) < 1.3


def test_a_star_that_is_dimmed_half_way_is_one_kind():
    rng, image = np.random.default_rng(3), np.full((SIDE, SIDE), 20.0)
    image[4:8, 4:8] = 2000.0
    images = rng.poisson(np.repeat([1.0, 0.5], COUNT // 2)[:, None, None] * image).astype(float)
    good = torch.ones(SIDE, SIDE, dtype=torch.bool)
    assert not kurtosis_of_frames(Frames(torch.as_tensor(images), good, NoiseModel(1.0, 1.0))) < 2


def test_speckles_and_vibrations_are_one_kind():
    assert _kurtosis(50 * np.random.default_rng(2).normal(size=COUNT)) > 2
    assert 1.4 < _kurtosis(70 * np.sin(2.4 * np.arange(COUNT))) < 1.7


def test_without_a_leading_direction_or_enough_frames_nothing_is_said():
    assert np.isnan(_kurtosis(np.zeros(COUNT)))
    assert np.isnan(_kurtosis(np.tile([50.0, -50.0], 8)))
