"""Calibration methods against the length of an exposure. Truth: sums written out, made-up numbers."""

import numpy as np
import pytest
from helpers import optics_cases as cases

from irlos_pipe.paper.common.calibrations import ObservedCube
from irlos_pipe.paper.common.scenes import cube_scene
from irlos_pipe.paper.exposures import summed


@pytest.fixture(scope="module")
def shortest():
    return ObservedCube.of(cube_scene("test", (31, 0), cases.FACILITY, 0.35, 7, 7.0))


def test_longer_exposures_are_sums_before_the_noise(shortest):
    long = summed(shortest, 3)
    first = shortest.exposed.mean_e[:3].sum(axis=0, dtype=float)
    assert long.exposed.mean_e.shape[0] == long.scene.frames == 2  # the seventh frame fills no exposure
    assert long.exposed.mean_e[0] == pytest.approx(first, rel=1e-5)
    assert long.scene.exposure_s == pytest.approx(0.3)
    assert long.exposed.zernike_nm[1] == pytest.approx(shortest.exposed.zernike_nm[3:6].mean(axis=0))
    assert summed(shortest, 1) is shortest


def test_a_sum_has_one_noise_of_its_own(shortest):
    long = summed(shortest, 3)
    noise = long.frames.images_e.numpy() - long.exposed.mean_e
    expected = long.exposed.mean_e + long.scene.detector.read_noise_e**2
    assert np.var(noise / np.sqrt(expected)) == pytest.approx(1, abs=0.06)
    assert not np.allclose(noise[0], (shortest.frames.images_e.numpy() - shortest.exposed.mean_e)[:3].sum(0))
