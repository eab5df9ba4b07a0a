"""Noise of an exposure of many reads. Truth: variances of independent parts add up (analysis)."""

import pytest

from irlos_pipe.frames.noise import ExposureNoise, NoiseModel


def test_reads_sky_and_dark_add_up_in_variance():
    noise = ExposureNoise(200, 1.0, 1.25, sky_e=14.0, dark_e=2.0)
    assert noise.floor_e2 == pytest.approx(200 + 1.25 * 16)


def test_what_was_recorded_is_the_least():
    noise = ExposureNoise(20, 1.0, 1.25)
    assert noise.beyond(NoiseModel(1.0, 1.0, 0.3)) == NoiseModel(1.25, 20.0, 0.3)
    assert noise.beyond(NoiseModel(1.47, 90.0)) == NoiseModel(1.47, 90.0)
