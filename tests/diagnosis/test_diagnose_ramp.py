"""Errors of a focus stage in made estimates of a ramp: what was put in is the truth."""

import numpy as np
import pytest

from irlos_pipe.diagnosis.ramp import diagnose_ramp
from irlos_pipe.stages.diagnose.work import frames_held_out

OFFSETS_NM = (-300, -200, -100, 0, 100, 200, 300, 250, 150, 50, -50, -150, -250)
COMMANDED_NM = np.repeat(np.array(OFFSETS_NM, float), 6)
DIRECTION = np.repeat([1, 1, 1, 1, 1, 1, 1, -1, -1, -1, -1, -1, -1], 6)


def diagnosed(estimated_nm: np.ndarray, seed: int = 0, commanded_nm: np.ndarray = COMMANDED_NM):
    """Estimates with a frame's noise of 4 nm and 1.5 nm common to a visit."""
    rng = np.random.default_rng(seed)
    noise = 4 * rng.standard_normal(len(commanded_nm)) + np.repeat(
        1.5 * rng.standard_normal(len(commanded_nm) // 6), 6
    )
    used = np.arange(len(commanded_nm)) % 4 != 3
    return diagnose_ramp(commanded_nm, estimated_nm + noise, used)


@pytest.mark.parametrize("seed", range(10))
def test_a_stage_that_follows_its_commands_gets_no_name(seed):
    assert diagnosed(COMMANDED_NM, seed).verdict == "none"


@pytest.mark.parametrize(
    ("course", "name", "size"),
    [
        (np.full(len(COMMANDED_NM), 40.0), "focus_stage_offset", 40.0),
        (0.15 * COMMANDED_NM, "focus_stage_scale", 0.15),
        (30.0 * DIRECTION, "focus_stage_hysteresis", 30.0),
    ],
    ids=["offset", "scale", "hysteresis"],
)
def test_each_error_is_named_with_its_size(course, name, size):
    result = diagnosed(COMMANDED_NM + course)
    assert result.verdict == "effect"
    (found,) = result.names
    assert found.name == name
    assert found.size == pytest.approx(size, abs=4 * found.sigma)
    assert found.explained > 0.9


def test_a_bias_of_the_upper_part_is_distinguished_from_one_of_the_whole():
    result = diagnosed(COMMANDED_NM + 50.0 * (COMMANDED_NM > 60))
    (found,) = result.names
    assert found.name == "focus_stage_offset"
    assert found.effect.above_nm == pytest.approx(75)


def test_two_errors_at_once_are_both_named():
    result = diagnosed(COMMANDED_NM * 1.12 + 45 * DIRECTION)
    assert {one.name for one in result.names} == {"focus_stage_scale", "focus_stage_hysteresis"}


def test_frames_in_another_order_than_commanded_are_no_error_of_the_stage():
    rng = np.random.default_rng(5)
    mixed = np.repeat(rng.permutation(np.array(OFFSETS_NM, float)), 6)
    assert diagnosed(mixed).verdict == "unknown"


def test_a_stage_that_would_have_to_err_beyond_what_stages_do_is_no_explanation():
    result = diagnosed(COMMANDED_NM + 450.0 * (COMMANDED_NM > 60))
    assert result.verdict == "unknown"


def test_a_ramp_that_misses_by_many_errors_is_not_explained_by_explaining_most_of_it():
    """More than 90 % of χ² is the scale; what is left, 20 nm from visit to visit, is five times its error."""
    rng = np.random.default_rng(3)
    scattered = np.repeat(20.0 * rng.standard_normal(len(OFFSETS_NM)), 6)
    assert diagnosed(1.29 * COMMANDED_NM + scattered).verdict == "unknown"


def test_of_short_visits_whole_ones_are_held_out_and_of_long_ones_their_last_frames():
    assert frames_held_out(np.arange(8.0), 4).tolist() == 2 * [False, False, False, True]
    assert frames_held_out(np.repeat([0.0, 50.0], 5), 4).nonzero()[0].tolist() == [3, 8]


def test_a_ramp_in_one_direction_cannot_show_hysteresis():
    commanded = np.repeat(np.arange(-300.0, 301.0, 100.0), 6)
    assert "focus_stage_hysteresis" in diagnosed(commanded, commanded_nm=commanded).untestable
