"""Ramps that their own numbers contradict fail the quality check; the message says what is likely wrong."""

import numpy as np
import pytest

from irlos_pipe.estimate.correction import modal_offsets
from irlos_pipe.estimate.lift import FrameErrors
from irlos_pipe.estimate.ramp import RampSummary, summarise
from irlos_pipe.stages.correct import sign_text
from irlos_pipe.stages.lift.stage import Config
from irlos_pipe.stages.lift.work import (
    WITHOUT_NCPAS,
    checks_of,
    offset_text,
    unexplained_offset_nm,
)

OFFSETS = np.repeat(np.arange(-300.0, 301.0, 100.0), 6)
NOMINAL = FrameErrors(4.0, 2.3, 2.2)
CHI2 = "chi2 of the frames"


def _ramp(slope: float, offset_nm: float = 0.0, scatter_nm: float = 4.0, offsets=OFFSETS) -> RampSummary:
    rng = np.random.default_rng(1)
    return summarise(offsets, slope * offsets + offset_nm + rng.normal(0, scatter_nm, len(offsets)))


def _failed(summary: RampSummary, errors: FrameErrors = NOMINAL, without_nm: float = 57.0) -> dict[str, str]:
    others = {WITHOUT_NCPAS: _ramp(1.03, without_nm)}
    checks = checks_of(Config(), 1.0, summary, others, errors, 5.0, len(OFFSETS))
    return {one.name: one.message for one in checks if not one.passed}


SIZE, SIGN = "size of the diversity", "sign of the diversity"


@pytest.mark.parametrize(
    ("ramp", "errors", "without_nm", "check", "said"),
    [
        *((_ramp(slope), NOMINAL, 57.0, "slope", SIZE) for slope in (0.5, 0.82, 1.23, 1.43)),
        (_ramp(-1.0), NOMINAL, 57.0, "slope", SIGN),
        (_ramp(-1.0), NOMINAL, 57.0, "error", SIGN),
        (_ramp(998.0, offsets=OFFSETS / 1000), NOMINAL, 57.0, "slope", SIZE),  # offsets in micrometres
        # the slope is right where the diversity of both cubes is turned; a constant 400 nm are not
        (_ramp(1.0, 400.0), NOMINAL, 57.0, "error", "constant offset"),
        (_ramp(1.0, 29.0, 1.0), NOMINAL, 6.0, "gain by the NCPAs", "another instrument"),
        *((_ramp(1.0), FrameErrors(4.0, one, 2.2), 57.0, CHI2, "orientation") for one in (15.0, 144.0)),
    ],
)
def test_a_ramp_that_its_own_numbers_contradict_fails_and_says_why(ramp, errors, without_nm, check, said):
    assert said in _failed(ramp, errors, without_nm)[check]


def test_a_right_ramp_passes_and_so_does_a_slope_that_its_error_explains():
    assert _failed(_ramp(1.002)) == {}
    noisy = _ramp(1.08, scatter_nm=25.0)
    assert noisy.slope_sigma > 0.016
    assert "slope" not in _failed(noisy)


@pytest.mark.parametrize("count", [3, 7])
def test_a_ramp_of_few_points_without_an_offset_is_told_of_one_by_chance_as_rarely_as_a_long_one(count):
    """In 0.27 % of the draws, 8 ± 3 of three thousand."""
    rng, introduced_nm = np.random.default_rng(count), np.linspace(-200.0, 200.0, count)
    ramps = [summarise(introduced_nm, introduced_nm + rng.normal(0, 20.0, count)) for _ in range(3000)]
    assert 1 <= sum(unexplained_offset_nm(one) > 0 for one in ramps) < 20
    squares = [one.offset_sigma_nm**2 for one in ramps]
    assert np.sqrt(np.mean(squares)) == pytest.approx(20.0 / np.sqrt(count), rel=0.05)


@pytest.mark.parametrize(("offset_nm", "unexplained"), [(20.0, True), (-20.0, True), (2.0, False)])
def test_an_offset_beyond_three_of_its_errors_is_told(offset_nm, unexplained):
    summary = _ramp(1.0, offset_nm)
    assert summary.offset_sigma_nm == pytest.approx(4.0 / np.sqrt(7), rel=0.2)  # one error per offset
    found_nm = unexplained_offset_nm(summary)
    assert found_nm == (abs(summary.offset_nm) if unexplained else 0.0)
    assert "calibration of another time" in offset_text(summary)


def test_a_part_of_the_wavefront_is_known_to_the_same_part_of_its_error():
    """Truth: the scatter of half the estimates."""
    drawn_nm = np.random.default_rng(5).normal(30.0, 8.0, 4000)
    half = [modal_offsets([2], [nm], [8.0], 0.5, 2) for nm in drawn_nm]
    values = [float(one.value_nm[0]) for one in half]
    assert np.mean(values) == pytest.approx(-15.0, abs=0.3)
    assert half[0].sigma_nm[0] == pytest.approx(np.std(values), rel=0.05)
    assert "-0.5 NCPA: " in sign_text(0.5) and "offset = -NCPA: " in sign_text(1.0)
