"""All methods with the same modes and frames. Truth: what was drawn, medians of made-up numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import optics_cases as cases
from helpers.experiment_stage import run_stage, section_of

from irlos_pipe.estimate.calibration_options import OPEN
from irlos_pipe.paper.common.cube import CubeSample, ObservedCube
from irlos_pipe.paper.common.results import Interval
from irlos_pipe.paper.common.variants import DEFAULT, METHOD_NAMES
from irlos_pipe.paper.ranking import stage
from irlos_pipe.paper.ranking.experiment import RankingSample, highest_nolls, rank, with_modes
from irlos_pipe.paper.ranking.section import section
from irlos_pipe.simulate.exposure import expose

SAMPLE = RankingSample(CubeSample("test", (31, 0), cases.FACILITY, 0.35, 6, 7.0), 0.0, (30, 51), (3,))


def test_a_tail_follows_the_drawn_ncpas_and_leaves_these_alone():
    without, tailed = SAMPLE.scene().ncpa_nm, replace(SAMPLE, tail_nm=3.0).scene().ncpa_nm
    assert set(without) == set(range(2, 52))
    assert set(tailed) == set(range(2, 201))
    assert all(tailed[noll] == without[noll] for noll in without)
    # 149 draws of 3 nm: their RMS is 3 nm within 3 / sqrt(2 · 149), here four times that.
    assert np.std([tailed[noll] for noll in range(52, 201)]) == pytest.approx(3.0, abs=0.7)


def test_every_method_has_the_modes_that_are_asked():
    for method in METHOD_NAMES:
        assert with_modes(method, 51).options.highest_noll == 51
        assert with_modes(method, 51).options.method == method
        assert (OPEN in highest_nolls(method, (30,))) == (method == DEFAULT)


def test_the_error_is_that_of_the_29_modes_over_the_whole_cube():
    cube = ObservedCube.of(SAMPLE.scene())
    truth_nm = cube.exposed.mean_zernike_nm()
    calibration = cube.calibrated(with_modes("lift_avg", 30))
    changed_nm = np.array([truth_nm[noll] for noll in calibration.nolls])
    changed_nm[[2, 5]] += (3.0, 4.0)
    telescope = cube.exposed.telescope
    wrong_nm = 3.0 * telescope.mode(4) + 4.0 * telescope.mode(7)
    weight = telescope.transmission / telescope.transmission.sum()
    mean_nm = np.sum(weight * wrong_nm)
    rms_nm = np.sqrt(np.sum(weight * (wrong_nm - mean_nm) ** 2))
    found = cube.modes_delta_nm(replace(calibration, zernike_nm=changed_nm))
    assert found == pytest.approx(rms_nm, rel=0.01)


def test_the_truth_holds_with_a_strong_tail():
    """Without a sky the mean wavefront is the static one, but for tip and tilt of the image motion."""
    scene = replace(replace(SAMPLE, tail_nm=10.0).scene(), sky=None, frames=1)
    found_nm = expose(scene).mean_zernike_nm()
    drawn_nm = [scene.ncpa_nm[noll] for noll in range(4, 31)]
    assert [found_nm[noll] for noll in range(4, 31)] == pytest.approx(drawn_nm, abs=0.01)


@pytest.mark.long
def test_every_method_is_tried_with_all_modes_and_with_fewer_frames():
    found = rank(replace(SAMPLE, highest_nolls=(30,)))
    wanted = {f"{method}/{which}" for method in METHOD_NAMES for which in ("30", "first_3")}
    assert set(found) == wanted | {f"{DEFAULT}/{OPEN}"}
    assert all(np.isfinite(value) and value > 0 for value in found.values())


def test_the_interval_of_a_median_holds_where_values_are_normal():
    # 90 % of such intervals hold the true median, 0; of 400 trials 90 ± 4.5 % at three standard errors.
    rng = np.random.default_rng(3)
    found = [Interval.of_median(rng.standard_normal(25)) for _ in range(400)]
    assert np.mean([one.low <= 0 <= one.high for one in found]) == pytest.approx(0.9, abs=0.06)
    assert Interval.of_median([1.0, 2.0, 9.0]).value == 2.0


def test_the_interval_of_few_samples_reaches_to_their_ends_and_that_of_one_is_unknown():
    # Smallest and largest of four values hold the median with 1 − 2 · 2⁻⁴ = 87.5 %; plain percentiles less.
    rng = np.random.default_rng(4)
    found = [Interval.of_median(rng.standard_normal(4)) for _ in range(400)]
    assert np.mean([one.low <= 0 <= one.high for one in found]) == pytest.approx(0.875, abs=0.05)
    one = Interval.of_median([1.0, 2.0, 9.0])
    assert (one.low, one.high) == pytest.approx((1.0, 9.0))
    assert np.isnan(Interval.of_rms([2.0]).low) and Interval.of_rms([2.0]).value == 2.0


@pytest.mark.parametrize(("open_nm", "kept"), [(2.0, True), (19.0, False)])
def test_a_default_that_another_method_beats_fails_its_check(monkeypatch, open_nm, kept):
    config = stage.Config(
        samples=2, samples_of_tails=0, samples_of_parts=1, seeings_arcsec=(0.35,), highest_nolls=(30, 66)
    )
    errors_nm = {f"{method}/{last}": 40.0 for method in METHOD_NAMES for last in (30, 66)}
    errors_nm |= {"lift_slices/66": 18.0, f"{DEFAULT}/open": open_nm}

    def found_of(sample):
        return errors_nm | {f"{method}/first_{n}": 50.0 for method in METHOD_NAMES for n in sample.parts}

    output = run_stage(monkeypatch, stage, config, found_of)
    (check,) = output.checks
    assert (check.passed, check.value) == (kept, pytest.approx(open_nm / 18.0))
    assert "LIFT slices" in check.message
    slices = next(row for row in output.results.rows if row.method == "lift_slices")
    assert (slices.modes["30"].value, slices.modes["66"].value) == (40.0, 18.0)
    assert set(slices.first) == {"10", "30", "100", "200"}
    figure, modes, frames = section_of(output, "ranking", section).blocks
    assert "LIFT slices" in figure.svg
    assert (len(modes.rows), len(frames.rows)) == (6, 6)


def test_the_ncpas_are_as_strong_as_stated(monkeypatch):
    config = stage.Config(samples=40, samples_of_tails=0, seeings_arcsec=(0.35,))
    errors_nm = {f"{m}/{last}": 1.0 for m in METHOD_NAMES for last in highest_nolls(m, (30, 51, 66))}
    results = run_stage(monkeypatch, stage, config, lambda sample: errors_nm).results
    # 142 ± 30 nm as drawn: the mean of 40 within 3 · 30 / sqrt(40).
    assert results.introduced_nm == pytest.approx(142, abs=15)
    assert results.introduced_scatter_nm == pytest.approx(30, abs=11)
