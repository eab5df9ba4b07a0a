"""Calibrations beside petals out of step.

Truth: the simulator, whose petals are drawn by other code than the model's; arithmetic on made-up wavefronts.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.experiment_stage import missed, run_on, sample, tables_of

from irlos_pipe.paper import low_wind
from irlos_pipe.paper.common.calibrations import ObservedCube
from irlos_pipe.paper.low_wind import NARROW, folded, in_reported_modes, left_of, rms, scene

STAR = sample(low_wind, sizes={"sizes_nm": (150.0,), "total_s": 4.0})
PATTERN = low_wind.pattern(STAR.seed, STAR.facility)


def test_whole_waves_of_a_petal_are_folded_and_parts_of_a_wave_stay():
    petal, weight = np.repeat([0, 1, 2, 3], 5), np.ones(20)
    small = np.tile([1.0, -2.0, 0.5, 0.0, 0.5], 4)
    waves = np.array([0.0, 1600.0, -3200.0, 300.0])
    assert folded(small + waves[petal], petal, weight, 1600.0) == pytest.approx(small + 300.0 * (petal == 3))


def test_nothing_is_left_where_modes_and_petals_are_those_of_the_scene():
    still = replace(scene(STAR, NARROW, 0.1, 150.0 * PATTERN), sky=None, motion=None, frames=2)
    cube = ObservedCube.of(still)
    table = {"piston_nm": (150.0 * PATTERN).tolist(), "tip_nm": [0.0] * 4, "tilt_nm": [0.0] * 4}
    nolls, values = zip(*still.ncpa_nm.items(), strict=True)
    right = SimpleNamespace(nolls=nolls, fitted_modes_nm=np.array(values), effects={"low_wind_effect": table})
    left_nm, petal, weight = left_of(cube, right)
    assert rms(left_nm, weight) < 0.1
    assert len(np.unique(petal)) == 4
    wrong_nm, *_ = left_of(cube, SimpleNamespace(**(vars(right) | {"effects": {}})))
    assert rms(wrong_nm, weight) == pytest.approx(150, rel=0.1)


def test_what_is_left_in_the_reported_modes_does_not_grow_by_modes_beyond_them():
    still = replace(scene(STAR, NARROW, 0.1, 0 * PATTERN), sky=None, motion=None, frames=1)
    cube = ObservedCube.of(still)
    lit, telescope = cube.exposed.transmission > 0, cube.exposed.telescope
    left_nm = (3.0 * telescope.mode(11) + 20.0 * telescope.mode(37))[lit]
    found_nm = in_reported_modes(cube, SimpleNamespace(nolls=range(2, 46)), left_nm)
    assert found_nm == pytest.approx(3.0 * telescope.mode(11)[lit], abs=0.01)


@pytest.mark.long
def test_petals_in_the_model_take_them_out_of_the_wavefront():
    without, with_petals, *_ = low_wind.rows(STAR)
    assert without["folded_nm"] > 4 * with_petals["folded_nm"]
    assert with_petals["chi2_nu"] < without["chi2_nu"]


NUMBERS = ("largest_difference_nm", "introduced_nm", "pupil_nm", "folded_nm", "modes_nm", "chi2_nu")


@pytest.mark.parametrize(("left_nm", "kept"), [(5.0, True), (12.0, False)])
def test_the_worst_cube_with_petals_in_the_model_is_judged(monkeypatch, left_nm, kept):
    def rows(star):
        for recording in ("narrow H, 0.1 s", "J+H, 0.1 s"):
            for model, judged_nm in (("without", 99.0), ("with", left_nm - star.seed[-1])):
                of = {"recording": recording, "size_nm": 200.0, "model": model, "judged_nm": judged_nm}
                yield of | dict.fromkeys(NUMBERS, 7.0)

    output = run_on(monkeypatch, low_wind, rows, samples=2)
    assert (not missed(output)) is kept and len(output.checks) == 2
    assert tables_of(output)["rows"].query("model == 'with'").worst_nm.tolist() == [left_nm] * 2
