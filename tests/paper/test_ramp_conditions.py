"""Ramps with colours, filters and dispersion.

Truth: the simulator, which shares no optics with LIFT's model; analysis of made-up estimates.
"""

from dataclasses import replace

import numpy as np
import pytest
from helpers.experiment_stage import sample

from irlos_pipe.paper import ramp_conditions
from irlos_pipe.paper.common.calibrations import DEFAULT
from irlos_pipe.paper.common.ramps import calibrated, observe
from irlos_pipe.paper.ramp_conditions import CONDITIONS, WAYS, cube_of, fit_way, mode_errors, ramp_of

SIZES = {"reach_nm": 200.0, "offsets": 3, "frames_per_offset": 1, "cube_frames": 40}
STAR = sample(ramp_conditions, sizes=SIZES | {"conditions": ("dispersion_100_at_0",)})
CUBE = cube_of(STAR)


def made_up(offset_nm: float = 0.0, slope: float = 0.05) -> dict:
    """Errors of a ramp of four frames by nine modes, with known errors."""
    introduced, modes = np.array([-100.0, -100.0, 100.0, 100.0]), WAYS["nine"].modes
    true = np.tile(np.array(modes, float), (4, 1))
    true[:, 2] += introduced
    found = true.copy()
    found[:, 2] += slope * introduced + offset_nm + np.array([1.0, -1.0, 1.0, -1.0])
    found[:, 3] += 0.01 * introduced
    return mode_errors(modes, introduced, true, found, 4.0)


def test_errors_are_told_apart_into_slope_mean_and_scatter():
    errors = made_up(offset_nm=2.0)
    assert errors["bias_nm"] == pytest.approx(2.0)
    assert errors["true_rms_nm"] == pytest.approx(np.sqrt(2.0**2 + 5.0**2 + 1.0))
    assert errors["rms_nm"] == pytest.approx(errors["true_rms_nm"])  # the NCPA given is the one there was
    assert errors["leak"][2:4] == pytest.approx([0.05, 0.01])
    assert errors["scatter_nm"][2] == pytest.approx(1.0)
    assert errors["true_scatter_nm"] == pytest.approx(np.zeros(9), abs=1e-9)
    assert errors["mode_nm"][3] == pytest.approx(1.0)


@pytest.mark.slow
def test_dispersion_is_found_by_the_default_and_misleads_a_model_without_it():
    default, plain = ramp_conditions.rows(STAR)
    assert (default["way"], plain["way"]) == ("default", "plain")
    assert default["true_rms_nm"] < 8
    assert plain["true_rms_nm"] > 20


@pytest.mark.slow
def test_held_tip_and_tilt_stay_where_they_are_held():
    ramp = ramp_of(CUBE, CONDITIONS["clean"], STAR.sizes)
    observed = observe(ramp, calibrated(CUBE, [DEFAULT]))
    free, held = (
        fit_way(observed, replace(WAYS[key], colour=False)) for key in ("default", "tilt_calibrated")
    )
    assert np.abs(held.result.zernike_nm[:, :2].numpy()).max() < 0.1
    assert np.abs(free.result.zernike_nm[:, :2].numpy()).max() > 1
