"""Ramps with colours, filters and dispersion.

Truth: the simulator, which shares no optics with LIFT's model; analysis of made-up estimates.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import optics_cases as cases
from helpers.experiment_stage import run_stage, section_of

from irlos_pipe.paper.common.ramps import calibrated, observe
from irlos_pipe.paper.common.results import Interval
from irlos_pipe.paper.ramp_conditions import stage
from irlos_pipe.paper.ramp_conditions.conditions import CONDITIONS, WAYS
from irlos_pipe.paper.ramp_conditions.experiment import DEFAULT, ConditionsSample, estimate, fit_way
from irlos_pipe.paper.ramp_conditions.outcome import errors_of
from irlos_pipe.paper.ramp_conditions.section import section
from irlos_pipe.simulate.exposure import expose

SAMPLE = ConditionsSample(
    "test",
    (31, 0),
    cases.FACILITY,
    (-200.0, 0.0, 200.0),
    1,
    40,
    ("clean", "dispersion_100_at_0"),
    0.35,
    7.0,
    12.0,
)


def effects(key: str) -> dict:
    return dict(SAMPLE.ramp(CONDITIONS[key]).effects)


def test_every_condition_names_ways_that_there_are():
    assert all(set(one.ways) <= set(WAYS) and one.ways for one in CONDITIONS.values())


def test_the_pair_is_a_cube_by_the_mirror_in_narrow_h_and_a_ramp_by_the_lens_in_j_and_h():
    cube, ramp = SAMPLE.cube(), SAMPLE.ramp(CONDITIONS["clean"])
    assert (len(cube.bands), len(ramp.bands)) == (1, 2)
    assert (cube.diversity_nm, ramp.diversity_nm) == ({6: 170.0}, {6: -170.0})
    assert (cube.diversity_source, ramp.diversity_source) == ("mirror", "lens")
    assert cube.ncpa_nm == ramp.ncpa_nm
    assert cube.seed != ramp.seed
    assert not ramp.effects


def test_chromatic_ncpas_have_their_size_between_j_and_h_and_none_at_the_calibration():
    made = effects("chromatic_60")["chromatic_ncpa"]
    slopes = made["zernike_nm_per_um"]
    assert np.linalg.norm(list(slopes.values())) * (1.625 - 1.215) == pytest.approx(60)
    assert min(slopes) == 4
    assert made["reference_nm"] == 1600


def test_a_lens_has_its_size_and_no_focus():
    made = effects("chromatic_60_filter_30")["filter_ncpa"]["zernike_nm"]
    assert np.linalg.norm(list(made.values())) == pytest.approx(30)
    assert min(made) == 5
    assert effects("filter_30")["filter_ncpa"]["zernike_nm"] == made


def test_the_ramp_in_narrow_h_has_the_light_of_the_cube():
    cube, ramp = SAMPLE.cube(), SAMPLE.ramp(CONDITIONS["narrow_h"])
    assert (ramp.bands, ramp.diversity_nm) == (cube.bands, cube.diversity_nm)
    assert (ramp.exposure_s, ramp.frames, ramp.seed == cube.seed) == (0.1, 3, False)


def made_up(offset_nm: float = 0.0) -> dict[str, np.ndarray]:
    """A ramp of four frames by nine modes, with known errors."""
    introduced = np.array([-100.0, -100.0, 100.0, 100.0])
    true = np.tile(np.arange(2.0, 12.0), (4, 1))
    true[:, 2] += introduced
    modes = true[:, [noll - 2 for noll in WAYS["nine"].modes]].copy()
    modes[:, 2] += 0.05 * introduced + offset_nm + np.array([1.0, -1.0, 1.0, -1.0])
    modes[:, 3] += 0.01 * introduced
    return {
        "introduced_nm": introduced,
        "clean/true_nm": true,
        "clean/nine/modes_nm": modes,
        "clean/nine/sigma_nm": np.full((4, 9), 0.5),
        "clean/nine/given_defocus_nm": np.array(4.0),
        "clean/nine/converged": np.array([True, True, True, False]),
    }


def test_errors_are_told_apart_into_slope_mean_and_scatter():
    errors = errors_of(made_up(offset_nm=2.0), "clean", "nine")
    assert errors.bias_nm == pytest.approx(2.0)
    assert errors.true_rms_nm == pytest.approx(np.sqrt(2.0**2 + 5.0**2 + 1.0))
    assert errors.rms_nm == pytest.approx(errors.true_rms_nm)  # the NCPA given is the one there was
    assert errors.leak[2:4] == pytest.approx([0.05, 0.01])
    assert errors.scatter_nm[2] == pytest.approx(1.0)
    assert errors.true_scatter_nm == pytest.approx(np.zeros(9), abs=1e-9)
    assert errors.mode_nm[3] == pytest.approx(1.0)
    assert errors.sigma_nm[0] == 0.5
    assert errors.converged == 0.75


def test_the_interval_of_an_rms_holds_it_and_closes_on_equal_values():
    one = Interval.of_rms([3.0, -3.0, 3.0])
    assert (one.value, one.low, one.high) == pytest.approx((3, 3, 3))
    drawn = np.random.default_rng(1).normal(0, 2.0, 4000)
    wide = Interval.of_rms(drawn)
    # standard error of an RMS of n normal values: sigma / sqrt(2 n)
    assert (wide.high - wide.low) / 2 == pytest.approx(1.645 * 2.0 / np.sqrt(8000), rel=0.1)
    assert wide.low < wide.value < wide.high


@pytest.mark.parametrize(("offset_nm", "kept"), [(0.0, True), (9.0, False)])
def test_a_ramp_with_a_larger_error_than_asked_fails_its_check(monkeypatch, offset_nm, kept):
    found = made_up(offset_nm)
    found["clean/nine/modes_nm"][:, 2] -= 0.05 * found["introduced_nm"]
    monkeypatch.setitem(CONDITIONS, "clean", replace(CONDITIONS["clean"], ways=("nine",)))
    config = stage.Config(samples=2, conditions=("clean",), offsets=3)
    output = run_stage(monkeypatch, stage, config, lambda sample: found)
    (check,) = output.checks
    assert check.passed is kept
    assert check.value == pytest.approx(np.hypot(offset_nm, 1.0))
    _, table, modes = section_of(output, "ramp_conditions", section).blocks
    assert list(table.marks) == ["good" if kept else "bad"]
    assert len(modes.rows) == 7


@pytest.mark.slow
def test_dispersion_is_found_by_the_default_and_misleads_a_model_without_it():
    found = estimate(replace(SAMPLE, conditions=("dispersion_100_at_0",)))
    errors = {way: errors_of(found, "dispersion_100_at_0", way).true_rms_nm for way in ("default", "plain")}
    assert errors["default"] < 8
    assert errors["plain"] > 20


@pytest.mark.slow
def test_held_tip_and_tilt_stay_where_they_are_held():
    ramp = SAMPLE.ramp(CONDITIONS["clean"])
    observed = observe(ramp, expose(ramp), calibrated(SAMPLE.cube(), [DEFAULT]))
    free, held = (
        fit_way(observed, replace(WAYS[key], colour=False)) for key in ("default", "tilt_calibrated")
    )
    assert np.abs(held.result.zernike_nm[:, :2].numpy()).max() < 0.1
    assert np.abs(free.result.zernike_nm[:, :2].numpy()).max() > 1
