"""Comparison of calibration methods on simulated cubes.

Truth: the simulator, which shares no optics with the model; arithmetic for the floor.
"""

import numpy as np
import pytest
import torch
from helpers.experiment_stage import sample

from irlos_pipe.effects import SeeingHalo
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.fourier_matrices import FocalGrid
from irlos_pipe.optics.grids import OtfGrid
from irlos_pipe.optics.structure_function import ResidualBand
from irlos_pipe.paper import methods
from irlos_pipe.paper.common.calibrations import DEFAULT, partial_halo
from irlos_pipe.paper.methods import speckle_floor_nm

FACILITY = load_instrument("irlos").facility


@pytest.mark.slow
def test_the_default_beats_the_mean_image_and_all_leave_less_than_was_introduced():
    of = {"shape": "power_law", "seeing_arcsec": 0.5, "dissected": True, "variants": (DEFAULT, "lift_avg")}
    star = sample(methods, (7, 0), FACILITY, {"frames": 24, "fractions": (0.5,)}, **of)
    default, lift, half = methods.rows(star)
    assert default["modes_nm"] < 0.5 * lift["modes_nm"]
    for row in (default, lift):
        assert row["modes_nm"] < row["pupil_nm"] < row["introduced_nm"]
    assert 0 < half["modes_nm"] < default["introduced_nm"] and half["part"] == 0.5


def test_the_floor_is_the_part_of_the_error_that_more_frames_remove():
    # Mean squares 4 + 9 / part.
    errors = {part: [np.sqrt(4 + 9 / part)] * 5 for part in (0.25, 0.5, 1.0)}
    assert speckle_floor_nm(errors) == pytest.approx((3.0, 2.0))
    assert speckle_floor_nm({0.5: [1.0], 1.0: [2.0]})[0] == 0.0  # never imaginary


def test_a_residual_without_direction_has_a_round_transfer_function():
    halo = partial_halo(SeeingHalo(ResidualBand(0.125, 2.5, 25.0), FACILITY.residual_law, 0.8), 2)
    wavelength_m = torch.tensor(1.6e-6, dtype=torch.float64)
    grid = OtfGrid(FocalGrid(96, 9.0, 96, 9.0), wavelength_m[None, None, None], wavelength_m)
    values = torch.tensor([1e4, 2.0], dtype=torch.float64)
    factor = halo.apply(values, torch.ones((), dtype=torch.float64), grid)[0].numpy()
    along_x, along_y = -np.log(factor[0, 1:20]), -np.log(factor[1:20, 0])
    assert along_x == pytest.approx(along_y, rel=1e-3)
