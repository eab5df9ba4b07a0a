"""Ramps that their own numbers contradict fail the quality check; the message says what is likely wrong."""

import numpy as np
import pytest

from irlos_pipe.estimate.ramp import RampSummary, summarise
from irlos_pipe.estimate.ramp_quality import FrameErrors
from irlos_pipe.stages.lift.quality import (
    WITHOUT_NCPAS,
    checks_of,
    offset_text,
    unexplained_offset_nm,
)
from irlos_pipe.stages.lift.stage import Config

OFFSETS = np.repeat(np.arange(-300.0, 301.0, 100.0), 6)
NOMINAL = FrameErrors(4.0, 2.3, 2.2)


def _ramp(slope: float, offset_nm: float = 0.0, scatter_nm: float = 4.0, offsets=OFFSETS) -> RampSummary:
    rng = np.random.default_rng(1)
    return summarise(offsets, slope * offsets + offset_nm + rng.normal(0, scatter_nm, len(offsets)))


def _failed(summary: RampSummary, errors: FrameErrors = NOMINAL, without_nm: float = 57.0) -> dict[str, str]:
    others = {WITHOUT_NCPAS: _ramp(1.03, without_nm)}
    checks = checks_of(Config(), 1.0, summary, others, errors, 5.0, len(OFFSETS))
    return {one.name: one.message for one in checks if not one.passed}


def test_a_right_ramp_passes():
    assert _failed(_ramp(1.002)) == {}


@pytest.mark.parametrize("slope", [0.5, 0.82, 1.23, 1.43])
def test_a_slope_beyond_its_error_fails(slope):
    assert "size of the diversity" in _failed(_ramp(slope))["slope"]


def test_a_negative_slope_says_that_a_sign_is_wrong():
    failed = _failed(_ramp(-1.0))
    assert "sign of the diversity" in failed["slope"]
    assert "sign of the diversity" in failed["error"]


def test_offsets_told_in_micrometres_fail():
    assert "slope" in _failed(_ramp(998.0, offsets=OFFSETS / 1000))


def test_a_noisy_ramp_may_have_a_slope_that_its_error_explains():
    noisy = _ramp(1.08, scatter_nm=25.0)
    assert noisy.slope_sigma > 0.016
    assert "slope" not in _failed(noisy)


def test_defocus_turned_by_the_diversity_of_both_cubes_fails_by_its_error():
    """The slope is right; a constant 400 nm are not."""
    assert "constant offset" in _failed(_ramp(1.0, 400.0), without_nm=57.0)["error"]


def test_a_calibration_that_makes_its_ramp_worse_fails():
    assert "another instrument" in _failed(_ramp(1.0, 29.0, 1.0), without_nm=6.0)["gain by the NCPAs"]


@pytest.mark.parametrize("chi2_nu", [15.0, 56.0, 144.0])
def test_frames_that_the_model_misfits_fail(chi2_nu):
    assert "orientation" in _failed(_ramp(1.0), FrameErrors(4.0, chi2_nu, 2.2))["chi2 of the frames"]


def test_without_ncpas_the_error_is_what_the_run_is_to_show():
    checks = checks_of(Config(calibrated=False), 1.0, _ramp(1.0, 57.0), {}, NOMINAL, 0.0, len(OFFSETS))
    assert all(one.passed for one in checks)


@pytest.mark.parametrize(("offset_nm", "unexplained"), [(20.0, True), (-20.0, True), (2.0, False)])
def test_an_offset_beyond_three_of_its_errors_is_told(offset_nm, unexplained):
    summary = _ramp(1.0, offset_nm)
    assert summary.offset_sigma_nm == pytest.approx(4.0 / np.sqrt(7), rel=0.2)  # one error per offset
    found_nm = unexplained_offset_nm(summary)
    assert found_nm == (abs(summary.offset_nm) if unexplained else 0.0)
    assert "calibration of another time" in offset_text(summary)


def test_the_error_of_an_offset_far_from_the_frames_grows_with_the_lever():
    """At 300 nm from offsets that scatter by 100 nm RMS the slope's error counts three times the mean's."""
    summary = _ramp(1.0, offsets=np.repeat([200.0, 400.0], 30))
    assert summary.offset_sigma_nm == pytest.approx(4.0 * np.sqrt(10) / np.sqrt(2), rel=0.2)
    assert not unexplained_offset_nm(summary)
