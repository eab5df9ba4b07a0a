"""How faint LIFT goes. Truth: the simulator, which shares no optics with LIFT's model; counting by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import optics_cases as cases
from helpers.experiment_stage import run_stage, section_of
from pydantic import ValidationError

from irlos_pipe.estimate.sensitivity import MEDIAN_OF_NORMAL, Criterion
from irlos_pipe.paper.faint import stage
from irlos_pipe.paper.faint.experiment import (
    COMPARED,
    Exposures,
    FaintSample,
    dim_and_estimate,
    pooled,
    residual_floor_nm,
    scenes_of,
)
from irlos_pipe.paper.faint.section import section as faint_section

SHORT = Exposures(0.1, (9.0, 13.0))
SAMPLE = FaintSample("test", (33, 0), cases.FACILITY, (SHORT,), (-100.0, 100.0), 2, 20, 0.4, 7.1)


@pytest.fixture(scope="module")
def found():
    return dim_and_estimate(SAMPLE)


# -- the experiment ------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_variant_has_an_error_for_every_frame_and_realisation(found):
    assert all(found[f"0.1/{key}/abs_error_nm"].shape == (2, 4) for key in COMPARED)


@pytest.mark.slow
def test_calibrated_ncpas_leave_the_residual_of_the_sky(found):
    default, none = (np.median(found[f"0.1/{key}/abs_error_nm"][0]) for key in ("default_3", "none_3"))
    assert default < np.abs(found["0.1/residual_nm"]).max() + 10
    assert default < 0.6 * none


@pytest.mark.slow
def test_the_bound_grows_as_the_star_fades(found):
    bright, faint = found["0.1/default_3/crb_nm"]
    # Four magnitudes: between the square root of the flux, and the flux, which read noise alone would give.
    assert 10**0.8 < faint / bright < 10**1.6


def test_ramps_differ_from_the_cube_in_time_and_defocus_only():
    long = Exposures(1.0, (9.0,))
    cube, (short_ramp, long_ramp) = scenes_of(replace(SAMPLE, exposures=(SHORT, long)))
    assert short_ramp.ncpa_nm == long_ramp.ncpa_nm == cube.ncpa_nm and 4 not in cube.ncpa_nm
    assert cube.bands == short_ramp.bands and cube.diversity_nm == {6: 170.0}
    assert len({cube.seed, short_ramp.seed, long_ramp.seed}) == 3
    assert long_ramp.photons == pytest.approx(10 * short_ramp.photons)


# -- all samples ---------------------------------------------------------------------------------


def made(errors, residual=0.0) -> dict[str, np.ndarray]:
    return {
        "0.1/default_3/abs_error_nm": np.array(errors, float),
        "0.1/default_3/crb_nm": np.array([1.0, 4.0]),
        "0.1/default_3/one_read_crb_nm": np.array([0.5, 1.0]),
        "0.1/residual_nm": np.array([residual, -residual]),
    }


def test_curves_pool_the_errors_of_all_samples():
    samples = [made([[1, 2], [30, np.nan]]), made([[3, 4], [50, 40]])]
    curve = pooled(samples, SHORT, "default_3", Criterion(30.0, 0.1))
    assert curve.median_abs_error_nm.tolist() == [2.5, 40.0]
    assert (curve.trials, curve.failures.tolist()) == (4, [0, 1])
    assert curve.mag_j.tolist() == [9.0, 13.0]


def test_the_floor_is_the_median_error_of_a_sensor_without_error():
    assert residual_floor_nm([made([[1], [1]], 3.0), made([[1], [1]], 4.0)], SHORT) == pytest.approx(
        MEDIAN_OF_NORMAL * np.sqrt(12.5)
    )


# -- stage and report ----------------------------------------------------------------------------


def test_every_length_of_exposure_has_its_own_magnitudes():
    config = stage.Config(exposures_s=(0.1, 1.0), faintest_mag_j=(18.0, 20.0), magnitudes=3, mag_step=2.0)
    assert config.scans() == (Exposures(0.1, (14.0, 16.0, 18.0)), Exposures(1.0, (16.0, 18.0, 20.0)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"faintest_mag_j": (19.0,)}, "one value for each of exposures_s"),
        ({"magnitudes": 20}, "frames can only be dimmed; lower magnitudes"),
    ],
)
def test_scans_that_cannot_be_made_are_refused(changes, message):
    with pytest.raises(ValidationError, match=message):
        stage.Config(**changes)


@pytest.mark.slow
def test_the_stage_gives_a_curve_per_variant_and_the_section_draws_them(found, monkeypatch):
    config = stage.Config(exposures_s=(0.1,), faintest_mag_j=(13.0,), magnitudes=2, mag_step=4.0, samples=2)
    output = run_stage(monkeypatch, stage, config, lambda sample: found)
    (group,) = output.results.exposures
    assert [curve.key for curve in group.curves] == list(COMPARED)
    assert {curve.trials for curve in group.curves} == {8}
    figure, table = section_of(output, "faint", faint_section).blocks
    assert figure.title == "Exposures of 0.1 s"
    assert "this pipeline, 3 modes" in figure.svg and "AO residual" in figure.svg
    assert table.marks == ["", "", "", "", "good", "good"]
    assert table.columns[2] == "limit at 0.1 s [J mag]"
