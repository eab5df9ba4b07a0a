"""Errors of frames of a ramp, against noise that was drawn."""

import numpy as np
import pytest
import torch

from irlos_pipe.estimate.lift_errors import (
    FrameErrors,
    excess_scatter_nm,
    instant_error_nm,
    nominal_frame_chi2,
)
from irlos_pipe.frames.noise import NoiseModel

OFFSETS = np.repeat(np.arange(-300.0, 301.0, 100.0), 40)


def test_scatter_at_one_offset_is_the_defocus_of_the_ao_residual():
    rng = np.random.default_rng(1)
    estimated = 1.1 * OFFSETS + 30 + rng.normal(0, 4.0, OFFSETS.size) + rng.normal(0, 1.0, OFFSETS.size)
    found = excess_scatter_nm(OFFSETS, estimated, np.ones(OFFSETS.size))
    assert found == pytest.approx(4.0, rel=0.15)  # 273 degrees of freedom: 4 %


def test_photon_noise_alone_leaves_no_excess_beyond_chance():
    rng = np.random.default_rng(2)
    found = excess_scatter_nm(OFFSETS, OFFSETS + rng.normal(0, 1.0, OFFSETS.size), np.ones(OFFSETS.size))
    assert found < 0.5


def test_one_frame_per_offset_is_judged_by_the_scatter_about_the_line():
    rng = np.random.default_rng(3)
    offsets = np.linspace(-300, 300, 200)
    found = excess_scatter_nm(offsets, offsets + rng.normal(0, 5.0, 200), np.full(200, 3.0))
    assert found == pytest.approx(4.0, rel=0.25)


def test_errors_that_last_for_an_offset_are_errors_of_frames_all_the_same():
    rng = np.random.default_rng(5)
    lasting = np.repeat(rng.normal(0, 6.0, 400), 3)
    offsets = np.repeat(np.linspace(-300, 300, 400), 3)
    estimated = offsets + lasting + rng.normal(0, 2.5, 1200) + 20
    photon = np.full(1200, 1.5)
    assert instant_error_nm(offsets, estimated, photon) == pytest.approx(np.sqrt(36 + 4), rel=0.1)
    assert excess_scatter_nm(offsets, estimated, photon) == pytest.approx(2.0, rel=0.15)


def test_errors_add_noise_grown_by_the_misfit_residual_and_calibration():
    errors = FrameErrors(instant_nm=4.0, chi2_nu=8.0, nominal_chi2_nu=2.0)
    assert errors.sigma_nm(np.array([1.5]), 12.0)[0] == pytest.approx(np.sqrt(3**2 + 4**2 + 12**2))
    assert FrameErrors(0.0, 0.5, 1.0).growth == FrameErrors(0.0, 5.0, float("nan")).growth == 1.0


def test_what_frames_have_in_common_is_no_part_of_the_nominal_chi2():
    rng = np.random.default_rng(4)
    model = torch.full((60, 20, 20), 100.0)
    misfit = 30 * rng.normal(size=(20, 20))
    images = torch.as_tensor(rng.poisson(100.0, (60, 20, 20)) + misfit)
    good = torch.ones(20, 20, dtype=torch.bool)
    noise = NoiseModel(1.0, 0.0)
    introduced = np.repeat([0.0, 100.0, 200.0], 20)
    assert nominal_frame_chi2(images, model, good, noise, introduced, 0) == pytest.approx(1.0, abs=0.05)
    alone = nominal_frame_chi2(images[:3], model[:3], good, noise, np.array([0.0, 1.0, 2.0]), 0)
    assert np.isnan(alone)
