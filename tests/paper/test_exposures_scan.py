"""Calibration methods against the length of an exposure. Truth: sums written out, made-up numbers."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import optics_cases as cases
from helpers.experiment_stage import run_stage, section_of

from irlos_pipe.paper.common.cube import CubeSample, ObservedCube
from irlos_pipe.paper.exposures import stage
from irlos_pipe.paper.exposures.experiment import ExposuresSample, summed
from irlos_pipe.paper.exposures.section import section

SAMPLE = ExposuresSample(
    CubeSample("test", (31, 0), cases.FACILITY, 0.35, 7, 7.0), 0.02, (1, 3), ("long_exposure",)
)


@pytest.fixture(scope="module")
def shortest():
    return ObservedCube.of(SAMPLE.scene())


def test_longer_exposures_are_sums_before_the_noise(shortest):
    long = summed(shortest, 3)
    first = shortest.exposed.mean_e[:3].sum(axis=0, dtype=float)
    assert long.exposed.mean_e.shape[0] == long.scene.frames == 2  # the seventh frame fills no exposure
    assert long.exposed.mean_e[0] == pytest.approx(first, rel=1e-5)
    assert long.scene.exposure_s == pytest.approx(0.06)
    assert long.exposed.zernike_nm[1] == pytest.approx(shortest.exposed.zernike_nm[3:6].mean(axis=0))


def test_a_sum_has_one_noise_of_its_own(shortest):
    long = summed(shortest, 3)
    noise = long.frames.images_e.numpy() - long.exposed.mean_e
    expected = long.exposed.mean_e + long.scene.detector.read_noise_e**2
    assert np.var(noise / np.sqrt(expected)) == pytest.approx(1, abs=0.06)
    assert not np.allclose(noise[0], (shortest.frames.images_e.numpy() - shortest.exposed.mean_e)[:3].sum(0))


def test_a_sum_of_one_is_the_cube_itself(shortest):
    assert summed(shortest, 1) is shortest


@pytest.mark.parametrize(("long_nm", "kept"), [(2.2, True), (4.0, False)])
def test_a_default_that_depends_on_the_exposure_fails_its_check(monkeypatch, long_nm, kept):
    config = stage.Config(
        samples=2, seeings_arcsec=(0.35,), sums=(1, 10), methods=("long_exposure", "dip_global")
    )
    found = {
        "1/long_exposure/modes_nm": 2.0,
        "10/long_exposure/modes_nm": long_nm,
        "1/dip_global/modes_nm": 20.0,
        "10/dip_global/modes_nm": 40.0,
    }
    output = run_stage(monkeypatch, stage, config, lambda sample: found)
    (check,) = output.checks
    assert (check.passed, check.value) == (kept, pytest.approx(long_nm / 2.0))
    default, dip = output.results.rows
    assert [one.median for one in dip.modes_nm] == [20.0, 40.0]
    assert (default.best_s, output.results.exposures_s) == (0.02, pytest.approx([0.02, 0.2]))
    figure, table = section_of(output, "exposures", section).blocks
    assert "DIP global" in figure.svg
    assert len(table.rows) == 2
