"""Experiments on the strength and the number of the modes. Truth: the simulator, and what it introduced."""

import numpy as np
import pytest

from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.paper.common.cube import CubeSample
from irlos_pipe.paper.mode_number.experiment import NumberSample, errors_by_number
from irlos_pipe.paper.mode_statistics.experiment import (
    INTRODUCED,
    StatisticsSample,
    beyond_nm,
    estimate_modes,
)

CUBE = CubeSample("a", (3, 0), load_instrument("irlos").facility, 0.5, 32, 7.0)


@pytest.fixture(scope="module")
def statistics():
    return estimate_modes(StatisticsSample(CUBE, 61, {"long_exposure": 32, "dip_global": 2}))


@pytest.fixture(scope="module")
def numbers():
    magnitudes = {"long_exposure": (7.0,), "lift_avg": (7.0, 16.0)}
    frames = {"long_exposure": 32, "lift_avg": 32}
    return errors_by_number(NumberSample(CUBE, (31, 51), magnitudes, frames))


@pytest.mark.slow
def test_fifty_modes_are_introduced_and_the_rest_is_zero(statistics):
    nolls = np.arange(2, 62)
    assert np.all(statistics["introduced_nm"][nolls <= INTRODUCED] != 0)
    assert np.all(statistics["introduced_nm"][nolls > INTRODUCED] == 0)


@pytest.mark.slow
def test_the_default_hardly_sees_modes_that_are_not_there(statistics):
    nolls = np.arange(2, 62)
    found = {
        name: beyond_nm(nolls, np.abs(statistics[f"{name}/zernike_nm"]))
        for name in ("long_exposure", "dip_global")
    }
    assert found["long_exposure"] < 3
    assert found["dip_global"] > 2 * found["long_exposure"]


def test_the_rms_beyond_counts_modes_not_introduced_only():
    nolls = np.arange(2, 62)
    assert beyond_nm(nolls, np.where(nolls > INTRODUCED, 3.0, 100.0)) == pytest.approx(3.0)


@pytest.mark.long
def test_the_introduced_number_beats_fewer(numbers):
    few, right = numbers["long_exposure/error_nm"][0]
    assert right < 0.5 * few


@pytest.mark.long
def test_lift_errs_more_on_a_faint_star(numbers):
    bright, faint = numbers["lift_avg/error_nm"]
    assert faint[1] > bright[1]


@pytest.mark.long
def test_unseen_frames_recommend_no_fewer_than_the_introduced_modes(numbers):
    assert numbers["recommended_noll"] == 51
    assert numbers["held_out"][0] > numbers["held_out"][1]
