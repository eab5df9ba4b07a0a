"""Comparison of calibration methods on simulated cubes.

Truth: the simulator, which shares no optics with the model; arithmetic for the floor; Monte Carlo for its
noise.
"""

import numpy as np
import pytest
import torch

from irlos_pipe.effects import SeeingHalo
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.fourier_matrices import FocalGrid
from irlos_pipe.optics.grids import OtfGrid
from irlos_pipe.optics.structure_function import ResidualBand
from irlos_pipe.paper.common.cube import CubeSample
from irlos_pipe.paper.common.variants import DEFAULT, VARIANTS, partial_halo, sharpest_half
from irlos_pipe.paper.methods.experiment import Sample, compare, speckle_floor_nm
from irlos_pipe.paper.methods.results import Distribution

FACILITY = load_instrument("irlos").facility


def cube(**changes) -> CubeSample:
    return CubeSample(
        **{
            "name": "a",
            "seed": (7, 0),
            "facility": FACILITY,
            "seeing_arcsec": 0.5,
            "frames": 24,
            "mag_j": 7.0,
        }
        | changes
    )


@pytest.fixture(scope="module")
def numbers():
    return compare(Sample(cube(), (DEFAULT, "lift_avg"), (0.5,)))


@pytest.mark.slow
def test_the_default_beats_the_mean_image_without_residual(numbers):
    assert numbers[f"{DEFAULT}/modes_nm"] < 0.5 * numbers["lift_avg/modes_nm"]


@pytest.mark.slow
def test_estimates_leave_less_than_was_introduced(numbers):
    assert all(numbers[f"{name}/pupil_nm"] < numbers["introduced_nm"] for name in (DEFAULT, "lift_avg"))


@pytest.mark.slow
def test_the_full_pupil_holds_what_the_modes_hold_and_more(numbers):
    assert all(numbers[f"{name}/pupil_nm"] > numbers[f"{name}/modes_nm"] for name in (DEFAULT, "lift_avg"))


@pytest.mark.slow
def test_a_part_of_the_cube_is_compared_as_well(numbers):
    assert 0 < numbers["fraction_0.5/modes_nm"] < numbers["introduced_nm"]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_numbers_to_the_bit(numbers):
    again = compare(Sample(cube(), (DEFAULT,)))
    assert again[f"{DEFAULT}/modes_nm"] == numbers[f"{DEFAULT}/modes_nm"]


def test_samples_of_one_index_share_their_ncpas_at_every_seeing():
    assert cube().scene().ncpa_nm == cube(seeing_arcsec=1.0, shape="aliasing").scene().ncpa_nm


@pytest.mark.slow
def test_introduced_ncpas_have_the_spread_of_the_paper():
    totals = [np.linalg.norm(list(cube(seed=(1, k)).scene().ncpa_nm.values())) for k in range(400)]
    assert np.mean(totals) == pytest.approx(142, abs=4 * 30 / 20)
    assert np.std(totals) == pytest.approx(30, rel=0.15)


def test_the_floor_is_the_part_of_the_error_that_more_frames_remove():
    # Mean squares 4 + 9 / part.
    errors = {part: [np.sqrt(4 + 9 / part)] * 5 for part in (0.25, 0.5, 1.0)}
    assert speckle_floor_nm(errors) == pytest.approx((3.0, 2.0))


def test_the_floor_is_never_imaginary():
    assert speckle_floor_nm({0.5: [1.0], 1.0: [2.0]})[0] == 0.0


def test_a_distribution_quotes_the_normal_distributions_one_sigma():
    values = np.random.default_rng(3).normal(50.0, 5.0, 40_000)
    found = Distribution.of(values)
    assert (found.p16_nm, found.median_nm, found.p84_nm) == pytest.approx((45, 50, 55), abs=0.2)


def test_the_range_of_a_median_is_that_of_its_standard_error():
    """Truth: the median of n normal values scatters by 1.2533 σ/√n; 90 % lie within ±1.645 of that."""
    found = Distribution.of(np.random.default_rng(3).normal(50.0, 5.0, 400))
    assert found.low_nm < found.median_nm < found.high_nm
    assert found.high_nm - found.low_nm == pytest.approx(2 * 1.645 * 1.2533 * 5 / 20, rel=0.3)


def test_the_sharpest_half_is_the_half_with_less_blur():
    y, x = np.mgrid[-8:9, -8:9]
    widths = (1.0, 3.0, 1.2, 2.5)
    images = np.array([np.exp(-(x**2 + y**2) / (2 * w**2)) for w in widths])
    frames = Frames(torch.as_tensor(images), torch.ones(17, 17, dtype=torch.bool), NoiseModel(1.0, 1.0))
    assert torch.equal(sharpest_half(frames).images_e, frames.images_e[[0, 2]])


def test_a_residual_without_direction_has_a_round_transfer_function():
    halo = partial_halo(SeeingHalo(ResidualBand(0.125, 2.5, 25.0), FACILITY.residual_law, 0.8), 2)
    wavelength_m = torch.tensor(1.6e-6, dtype=torch.float64)
    grid = OtfGrid(FocalGrid(96, 9.0, 96, 9.0), wavelength_m[None, None, None], wavelength_m)
    values = torch.tensor([1e4, 2.0], dtype=torch.float64)
    factor = halo.apply(values, torch.ones((), dtype=torch.float64), grid)[0].numpy()
    along_x, along_y = -np.log(factor[0, 1:20]), -np.log(factor[1:20, 0])
    assert along_x == pytest.approx(along_y, rel=1e-3)


def test_every_variant_says_what_it_is():
    assert all(variant.label for variant in VARIANTS.values())
