"""Summary of a focus ramp, and errors of its frames. Truth: analysis on made-up estimates, drawn noise."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from irlos_pipe.estimate.lift_errors import (
    FrameErrors,
    excess_scatter_nm,
    instant_error_nm,
    nominal_frame_chi2,
)
from irlos_pipe.estimate.ramp import summarise, travel_direction
from irlos_pipe.frames.noise import NoiseModel

OFFSETS_NM = np.array([-300.0, 300, -200, 200, -100, 100, 0])  # every move reverses the travel


def repeated(values, frames: int = 4) -> np.ndarray:
    return np.repeat(np.asarray(values, float), frames)


def test_a_straight_ramp_gives_back_its_line():
    introduced = repeated(OFFSETS_NM)
    summary = summarise(introduced, 1.03 * introduced - 12.0)
    assert (summary.slope, summary.offset_nm) == pytest.approx((1.03, -12.0))
    assert summary.residual_rms_nm == pytest.approx(0, abs=1e-9)
    # RMS of 0.03 x - 12 over symmetric offsets: the two parts add in squares
    assert summary.rms_nm == pytest.approx(np.hypot(12.0, 0.03 * np.sqrt(np.mean(OFFSETS_NM**2))))


@pytest.mark.parametrize("hysteresis_nm", [14.0, -6.0])
def test_hysteresis_is_told_from_slope_and_offset(hysteresis_nm):
    """On a ramp from the outside inwards the direction goes with the sign of the offset."""
    introduced = repeated(OFFSETS_NM)
    bias = travel_direction(introduced) * hysteresis_nm / 2
    summary = summarise(introduced, 0.98 * introduced + 5.0 + bias)
    assert summary.saw_tooth_nm == pytest.approx(hysteresis_nm)


def halves(introduced: np.ndarray) -> np.ndarray:
    """True for the frames of the second half of the recording."""
    return np.arange(len(introduced)) >= len(introduced) // 2


@pytest.mark.parametrize("bias_nm", [25.0, -40.0])
def test_the_bias_of_a_second_run_is_told_from_slope_offset_and_saw_tooth(bias_nm):
    introduced = repeated(OFFSETS_NM)
    second = halves(introduced)
    estimated = 0.97 * introduced + 4.0 + 9.0 * travel_direction(introduced) + bias_nm * second
    summary = summarise(introduced, estimated, second)
    assert summary.part_bias_nm == pytest.approx(bias_nm)
    assert summary.saw_tooth_nm == pytest.approx(18.0)


def test_what_looks_the_same_is_not_told_apart():
    """A second run that goes down where the first went up: direction and part are one column."""
    introduced = repeated([0.0, 100, 200, 150, 50])
    direction = travel_direction(introduced)
    summary = summarise(introduced, introduced + 20.0 * (direction < 0), direction < 0)
    assert np.isnan([summary.saw_tooth_nm, summary.part_bias_nm]).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["slope", "saw_tooth", "part_bias"])
def test_quoted_errors_are_the_scatter_over_many_ramps(name):
    rng = np.random.default_rng(2)
    introduced = repeated(OFFSETS_NM)
    ramps = [
        summarise(introduced, introduced + 20 * rng.standard_normal(len(introduced)), halves(introduced))
        for _ in range(800)
    ]
    value, sigma, true = {
        "slope": ("slope", "slope_sigma", 1.0),
        "saw_tooth": ("saw_tooth_nm", "saw_tooth_sigma_nm", 0.0),
        "part_bias": ("part_bias_nm", "part_bias_sigma_nm", 0.0),
    }[name]
    values = np.array([getattr(ramp, value) for ramp in ramps])
    quoted = np.array([getattr(ramp, sigma) for ramp in ramps])
    assert np.sqrt(np.mean(quoted**2)) == pytest.approx(values.std(), rel=0.08)
    assert values.mean() == pytest.approx(true, abs=4 * values.std() / np.sqrt(800))


def test_failed_estimates_are_left_out_and_keep_the_direction_of_the_others():
    introduced = repeated(OFFSETS_NM)
    estimated = 0.9 * introduced
    estimated[[0, 5, 13]] = np.nan
    assert summarise(introduced, estimated).slope == pytest.approx(0.9)


@pytest.mark.parametrize(
    "estimated", [[np.nan] * 6 + [1.0, 2.0], [1.0] * 2 + [np.nan] * 6], ids=["two", "one offset"]
)
def test_too_little_for_a_line_is_refused(estimated):
    with pytest.raises(ValueError, match="at least three estimates"):
        summarise(repeated([-100.0, 100.0]), np.array(estimated))


# -- errors of frames ----------------------------------------------------------------------------


OFFSETS = np.repeat(np.arange(-300.0, 301.0, 100.0), 40)


def test_scatter_at_one_offset_is_the_defocus_of_the_ao_residual():
    rng = np.random.default_rng(1)
    estimated = 1.1 * OFFSETS + 30 + rng.normal(0, 4.0, OFFSETS.size) + rng.normal(0, 1.0, OFFSETS.size)
    found = excess_scatter_nm(OFFSETS, estimated, np.ones(OFFSETS.size))
    assert found == pytest.approx(4.0, rel=0.15)  # 273 degrees of freedom: 4 %


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
