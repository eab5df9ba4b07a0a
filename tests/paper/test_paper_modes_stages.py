"""Stages and sections of the derotator series and the mode experiments, on made samples. Truth: what they
were made from."""

import numpy as np
import pytest
from helpers import experiment_stage as bench

from irlos_pipe.paper.derotator_series import stage as derotator_series
from irlos_pipe.paper.derotator_series.experiment import AngleSample
from irlos_pipe.paper.derotator_series.section import section as derotator_series_section
from irlos_pipe.paper.mode_number import stage as mode_number
from irlos_pipe.paper.mode_number.experiment import NumberSample
from irlos_pipe.paper.mode_number.section import section as mode_number_section
from irlos_pipe.paper.mode_statistics import stage as mode_statistics
from irlos_pipe.paper.mode_statistics.experiment import StatisticsSample
from irlos_pipe.paper.mode_statistics.section import section as mode_statistics_section
from irlos_pipe.report.content import Figure, Section, Stack, Table

ERROR_NM = {"long_exposure": 1.0, "dip_global": 20.0}


def blocks_of(section: Section) -> list[Figure | Table]:
    return [
        one for block in section.blocks for one in (block.blocks if isinstance(block, Stack) else [block])
    ]


def titles(section: Section) -> list[str]:
    return [block.title for block in blocks_of(section)]


# -- derotator series ---------------------------------------------------------------------------


def angle_estimates(sample: AngleSample) -> dict:
    """The static wavefront with noise of known size."""
    found = {"mean_image_e": np.ones((8, 8))}
    rng = np.random.default_rng(sample.seed)
    for method, error in ERROR_NM.items():
        nolls = np.arange(2, 67 if method == "long_exposure" else 31)
        found |= {
            f"{method}/noll": nolls,
            f"{method}/zernike_nm": sample.truth.at(nolls, sample.angle_deg)
            + error * rng.normal(size=len(nolls)),
            f"{method}/covariance_nm2": error**2 * np.eye(len(nolls)),
            f"{method}/chi2_nu": np.array(1.0),
            f"{method}/delta_nm": np.array(error * 29**0.5),
        }
    return found


@pytest.fixture(scope="module")
def series():
    with pytest.MonkeyPatch.context() as patch:
        return bench.run_stage(patch, derotator_series, derotator_series.Config(), angle_estimates)


@pytest.mark.slow
def test_parts_of_a_series_err_as_their_estimates_do(series):
    for method, error in ERROR_NM.items():
        found = series.results.methods[method]
        # 24 separable modes of Noll 4–30, each part's variance at least that of a mean of nine.
        expected = error * np.sqrt(24 / 9)
        assert expected / 2 < found.errors.rotating_nm < 2 * expected
        assert expected / 2 < found.errors.fixed_nm < 2 * expected
        assert found.errors.model_nm < found.errors.single_nm
        assert 0.8 < found.chi2_nu < 1.2
        assert (found.sense, found.delta_chi2 > 100) == ("anticlockwise", True)


def test_the_published_method_gets_the_first_frames_only():
    assert derotator_series.Config().published_frames < derotator_series.Config().frames
    frames = derotator_series.Config(frames=50).method_frames
    assert frames == {"long_exposure": 50, "dip_global": 50}


@pytest.mark.slow
def test_the_section_of_a_series_shows_angles_parts_and_errors(series):
    section = bench.section_of(series, "derotator_series", derotator_series_section)
    assert {
        "What turns with the derotator",
        "What does not turn",
        "Errors",
        "Agreement of the angles",
    } <= set(titles(section))
    angles = next(block for block in blocks_of(section) if block.title == "Angles one by one")
    assert [row[0] for row in angles.rows] == [
        "0°",
        "23°",
        "46°",
        "69°",
        "92°",
        "115°",
        "138°",
        "161°",
        "180°",
    ]


# -- strength of the modes ----------------------------------------------------------------------


def drawn_modes(sample: StatisticsSample) -> dict:
    """Modes of the law, fifty of them introduced, with noise."""
    rng = np.random.default_rng(sample.cube.seed)
    nolls = np.arange(2, sample.highest_noll + 1)
    law = 60 * np.exp(-0.15 * (nolls - 2)) + 8
    introduced = np.where(nolls <= 51, law * rng.normal(size=len(nolls)), 0.0)
    found = {"introduced_nm": introduced}
    for method, error in ERROR_NM.items():
        found |= {
            f"{method}/zernike_nm": introduced + error * rng.normal(size=len(nolls)),
            f"{method}/sigma_nm": np.full(len(nolls), error),
            f"{method}/chi2_nu": np.array(1.0),
        }
    return found


@pytest.fixture(scope="module")
def statistics():
    config = mode_statistics.Config(cubes=40)
    with pytest.MonkeyPatch.context() as patch:
        return bench.run_stage(patch, mode_statistics, config, drawn_modes)


def test_the_law_of_the_introduced_modes_is_found(statistics):
    law = statistics.results.laws_of_introduced_modes["introduced"]
    assert abs(law.A_nm - 60) < 3 * law.A_sigma_nm
    assert abs(law.B - 0.15) < 3 * law.B_sigma
    assert abs(law.C_nm - 8) < 3 * law.C_sigma_nm


def test_modes_beyond_are_the_error_of_the_estimate(statistics):
    beyond = statistics.results.beyond_nm
    assert beyond["introduced"] == 0
    for method, error in ERROR_NM.items():
        assert beyond[method] == pytest.approx(error, rel=0.05)
        assert np.median(statistics.results.error_nm[method]) == pytest.approx(error * 98**0.5, rel=0.05)


def test_noise_makes_the_plateau_of_the_published_method(statistics):
    assert statistics.results.laws["dip_global"].C_nm == pytest.approx(np.hypot(20, 5), rel=0.15)


def test_the_section_of_the_strengths_lists_every_law(statistics):
    section = bench.section_of(statistics, "mode_statistics", mode_statistics_section)
    laws = next(block for block in blocks_of(section) if block.title == "Law of the standard deviation")
    assert len(laws.rows) == 5
    assert "Strength of the modes" in titles(section)


# -- number of the modes ------------------------------------------------------------------------


def made_errors(sample: NumberSample) -> dict:
    """Errors that are least at 51 for the bright star and at 21 for the others."""
    numbers = np.array(sample.highest_nolls)
    found = {"recommended_noll": np.array(51), "held_out": np.abs(numbers - 51) + 1.0}
    for method, magnitudes in sample.magnitudes.items():
        best = [51 if mag == magnitudes[0] else 21 for mag in magnitudes]
        found[f"{method}/error_nm"] = np.array([2.0 + np.abs(numbers - one) for one in best])
    return found


@pytest.fixture(scope="module")
def numbers():
    with pytest.MonkeyPatch.context() as patch:
        return bench.run_stage(patch, mode_number, mode_number.Config(cubes=2), made_errors)


def test_the_best_number_is_reported_for_every_method_and_magnitude(numbers):
    config = mode_number.Config()
    lift = [one for one in numbers.results.curves if one.method == "lift_avg"]
    assert [one.best_noll for one in lift] == [51] + [21] * (len(config.magnitudes) - 1)
    assert all(one.best_nm == 2.0 for one in lift)
    dip = [one for one in numbers.results.curves if one.method == "dip_global"]
    assert [one.mag_j for one in dip] == [config.magnitudes[0]]


@pytest.mark.slow
def test_the_section_of_the_numbers_shows_both_figures_and_the_recommendation(numbers):
    section = bench.section_of(numbers, "mode_number", mode_number_section)
    assert titles(section) == [
        "Calibration",
        "LIFT avg.",
        "Best number of modes",
        "Recommended by unseen frames",
    ]
    assert blocks_of(section)[-1].rows == [("2–51", "2")]


@pytest.mark.parametrize("numbers", [(21, 11), (3, 11), (11, 300), (11, 11)])
def test_numbers_of_modes_rise(numbers):
    with pytest.raises(ValueError, match="rising numbers"):
        mode_number.Config(numbers=numbers)
