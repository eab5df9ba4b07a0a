"""Counts to electrons, levels, and the noise measured on a star."""

import numpy as np
import pytest
from helpers.sparta_files import SAMPLING_PX, counts, frames_e, star

from irlos_pipe.frames.cleaning import find_background
from irlos_pipe.frames.detector import (
    relative_flat,
    saturation_level,
    star_position,
    to_electrons,
)
from irlos_pipe.frames.measured_noise import measure_noise
from irlos_pipe.frames.neighbour_prediction import neighbour_prediction
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.frames.recording import CalibrationMaps, Detector

DETECTOR = Detector(e_per_adu=0.5, read_noise_e=1.0)


def test_electrons_are_counts_above_background_over_flat_times_gain():
    adu = np.array([[[110.0, 60.0]], [[10.0, 35.0]]])
    electrons = to_electrons(adu, np.array([[10.0, 10.0]]), np.array([[1.0, 0.5]]), e_per_adu=2.0)
    assert electrons.tolist() == [[[200.0, 200.0]], [[0.0, 100.0]]]
    assert electrons.dtype == np.float32 and adu[0, 0, 0] == 110
    assert to_electrons(np.array([[[3]]], np.uint16), np.array([[5.0]]), np.ones((1, 1)), 1.0)[0, 0, 0] == -2


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_pixel_whose_flat_is_no_positive_number_is_bad(value):
    flat, bad = relative_flat(np.array([[1.0, value, 1.0]]), (1, 3))
    assert bad.tolist() == [[False, True, False]]
    assert flat[0, 1] == 1


def test_dark_and_sky_add_up_to_the_background():
    maps = CalibrationMaps(dark_adu=np.full((8, 8), 6.0), background_adu=np.full((8, 8), 2.5))
    found = find_background(np.zeros((2, 8, 8)), maps, np.ones((8, 8), bool))
    assert (found.adu == 8.5).all()
    assert np.isnan(found.pedestal_adu)


@pytest.mark.parametrize("shape", [(32, 32), (31, 40)])
def test_the_star_is_found_where_it_is(shape):
    y, x = np.indices(shape)
    image = 7 + 1000 * np.exp(-((y - 12.3) ** 2 + (x - 17.8) ** 2) / 18)
    assert star_position(image) == pytest.approx((12.3, 17.8), abs=0.1)


@pytest.mark.parametrize(
    ("adu", "declared", "level"),
    [
        (counts(star()), 1234.0, 1234.0),
        (counts(star(flux_e=1e5)).astype(np.uint16), None, 65535),  # the end of the type
        (np.minimum(counts(star()), 16383), None, 16383),  # clipped counts betray it
    ],
    ids=["declared", "integer", "clipped"],
)
def test_saturation_is_declared_or_that_of_the_type_or_where_counts_are_clipped(adu, declared, level):
    assert saturation_level(adu, Detector(0.5, 1.0, saturation_adu=declared)) == level


def measured(images, detector=DETECTOR):
    good = np.ones(images.shape[1:], bool)
    return measure_noise(
        images.astype(np.float32),
        good,
        neighbour_prediction(good, SAMPLING_PX),
        NoiseModel.of_detector(detector),
    )


@pytest.mark.parametrize(("read_noise_e", "excess"), [(1.0, 1.0), (3.0, 1.0), (1.0, 1.4)])
def test_read_noise_and_excess_noise_are_measured_on_the_star_itself(read_noise_e, excess):
    image = star(64, 64, flux_e=3e5)
    normal = np.random.default_rng(2).normal(size=(100, *image.shape))
    noise = measured(image + np.sqrt(excess * image + read_noise_e**2) * normal)
    assert noise.floor_e2 == pytest.approx(read_noise_e**2, abs=5 * noise.floor_error_e2)
    assert noise.excess_noise_factor == pytest.approx(excess, rel=0.05)


def test_image_motion_is_no_noise():
    moving = np.stack(
        [
            star(64, 64, flux_e=3e5, shift_px=shift)
            for shift in np.random.default_rng(0).normal(0, 0.7, (60, 2))
        ]
    )
    rng = np.random.default_rng(1)
    noise = measured(rng.poisson(moving) + rng.normal(0, 1, moving.shape))
    assert noise.excess_noise_factor == pytest.approx(1.0, abs=0.1)


def test_sky_noise_beyond_the_read_noise_shows_in_the_floor():
    sky_e = 5.0
    noise = measured(frames_e(star(64, 64, flux_e=3e5) + sky_e, 100) - sky_e)
    assert noise.beyond_e2(1.0) == pytest.approx(sky_e, abs=5 * noise.floor_error_e2)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_noise_is_measured_in_few_frames_and_in_one(count):
    """In one, from the differences of neighbours where the star is faint: to a tenth of 100 e-²."""
    noise = measured(frames_e(star(64, 64, flux_e=1e5), count, read_noise_e=10.0))
    assert noise.floor_e2 == pytest.approx(100.0, abs=5 * noise.floor_error_e2)
    assert noise.floor_error_e2 < 12
    assert np.isnan(noise.excess_noise_factor) == (count == 1)
