"""Calibrations beside petals out of step.

Truth: the simulator, whose petals are drawn by other code than the model's; arithmetic on made-up wavefronts.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import optics_cases as cases
from helpers.experiment_stage import run_stage, section_of

from irlos_pipe.paper.common.cube import ObservedCube
from irlos_pipe.paper.low_wind import stage
from irlos_pipe.paper.low_wind.experiment import (
    BROAD,
    NARROW,
    LowWindSample,
    Recording,
    estimate,
    folded,
    in_reported_modes,
    left_of,
    rms,
)
from irlos_pipe.paper.low_wind.section import section

SHORT = Recording(NARROW, 0.1)
SAMPLE = LowWindSample("test", (31, 0), cases.FACILITY, (150.0,), (SHORT,), 4.0, 0.5, 7.0)


def test_a_pattern_has_no_mean_and_unit_rms_and_its_size_in_the_scene():
    assert len(SAMPLE.pattern) == 4
    assert (SAMPLE.pattern.mean(), SAMPLE.pattern.std()) == pytest.approx((0, 1), abs=1e-12)
    made = SAMPLE.scene(SHORT, 150.0).effects["low_wind_effect"]["piston_nm"]
    assert made == pytest.approx(150 * SAMPLE.pattern)
    assert not SAMPLE.scene(SHORT, 0.0).effects


def test_every_recording_has_the_same_light_through_its_own_optics():
    short, long, broad = (
        SAMPLE.scene(one, 0.0) for one in (SHORT, Recording(NARROW, 1.0), Recording(BROAD, 0.1))
    )
    assert (short.frames, long.frames, broad.frames) == (40, 4, 40)
    assert short.frames * short.photons == pytest.approx(long.frames * long.photons)
    assert (short.diversity_source, broad.diversity_source) == ("mirror", "lens")
    assert (len(short.bands), len(broad.bands)) == (1, 2)


def test_whole_waves_of_a_petal_are_folded_and_parts_of_a_wave_stay():
    petal, weight = np.repeat([0, 1, 2, 3], 5), np.ones(20)
    small = np.tile([1.0, -2.0, 0.5, 0.0, 0.5], 4)
    waves = np.array([0.0, 1600.0, -3200.0, 300.0])
    assert folded(small + waves[petal], petal, weight, 1600.0) == pytest.approx(small + 300.0 * (petal == 3))


def test_an_rms_is_about_the_weighted_mean():
    assert rms([1.0, 5.0], np.array([3.0, 1.0])) == pytest.approx(np.sqrt(3))


def test_nothing_is_left_where_modes_and_petals_are_those_of_the_scene():
    scene = replace(SAMPLE.scene(SHORT, 150.0), sky=None, motion=None, frames=2)
    cube = ObservedCube.of(scene)
    table = {
        f"{kind}_nm": [0.0] * 4 if kind != "piston" else (150.0 * SAMPLE.pattern).tolist()
        for kind in ("piston", "tip", "tilt")
    }
    nolls, values = zip(*scene.ncpa_nm.items(), strict=True)
    right = SimpleNamespace(nolls=nolls, fitted_modes_nm=np.array(values), effects={"low_wind_effect": table})
    left_nm, petal, weight = left_of(cube, right)
    assert rms(left_nm, weight) < 0.1
    assert len(np.unique(petal)) == 4
    wrong_nm, *_ = left_of(cube, SimpleNamespace(**(vars(right) | {"effects": {}})))
    assert rms(wrong_nm, weight) == pytest.approx(150, rel=0.1)


def test_what_is_left_in_the_reported_modes_does_not_grow_by_modes_beyond_them():
    cube = ObservedCube.of(replace(SAMPLE.scene(SHORT, 0.0), sky=None, motion=None, frames=1))
    lit, telescope = cube.exposed.transmission > 0, cube.exposed.telescope
    left_nm = (3.0 * telescope.mode(11) + 20.0 * telescope.mode(37))[lit]
    found_nm = in_reported_modes(cube, SimpleNamespace(nolls=range(2, 46)), left_nm)
    assert found_nm == pytest.approx(3.0 * telescope.mode(11)[lit], abs=0.01)


@pytest.mark.long
def test_petals_in_the_model_take_them_out_of_the_wavefront():
    found = estimate(SAMPLE)
    key = f"{SHORT.name}/150"
    assert found[f"{key}/without/folded_nm"] > 4 * found[f"{key}/with/folded_nm"]
    assert found[f"{key}/with/chi2_nu"] < found[f"{key}/without/chi2_nu"]


def numbers(sample: LowWindSample, left_nm: float) -> dict[str, float]:
    return {
        f"{recording.name}/{size:g}/{key}": value
        for recording in sample.recordings
        for size in sample.sizes_nm
        for key, value in {
            "introduced_nm": 150.0,
            "without/pupil_nm": 99.0,
            "without/folded_nm": 98.0,
            "without/modes_nm": 97.0,
            "without/chi2_nu": 9.0,
            "with/pupil_nm": 700.0 if recording.band == NARROW else left_nm,
            "with/folded_nm": left_nm,
            "with/modes_nm": left_nm,
            "with/chi2_nu": 0.5,
        }.items()
    }


@pytest.mark.parametrize(("left_nm", "kept"), [(5.0, True), (12.0, False)])
def test_one_band_is_asked_for_the_folded_wavefront_and_two_for_all_of_it(monkeypatch, left_nm, kept):
    config = stage.Config(samples=2, sizes_nm=(0.0, 200.0))
    output = run_stage(monkeypatch, stage, config, lambda sample: numbers(sample, left_nm))
    assert [check.passed for check in output.checks] == [kept] * 6
    rows = output.results.rows
    assert len(rows) == 12
    assert {row.pupil_nm.median for row in rows if row.model == "with"} == {700.0, left_nm}
    figure, table = section_of(output, "low_wind", section).blocks
    assert table.marks.count("good" if kept else "bad") == 6
    assert "J+H" in figure.svg
