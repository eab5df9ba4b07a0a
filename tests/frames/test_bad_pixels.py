"""Bad pixels and cosmic hits: those put in are found, and nothing else."""

import numpy as np
import pytest
from helpers.sparta_files import SAMPLING_PX, frames_e, star

from irlos_pipe.frames.bad_pixels import (
    Criteria,
    Thresholds,
    deviant_pixels,
    hot_in_dark,
    neighbour_prediction,
    noisy_pixels,
    stuck_pixels,
)
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.frames.recording import Detector
from irlos_pipe.frames.screening import cosmic_hits, flickering_pixels
from irlos_pipe.stages.ingest.stage import Config

DETECTOR = Detector(e_per_adu=0.5, read_noise_e=1.0)
THRESHOLDS = Config().part(Thresholds)
ALL = np.ones((48, 44), bool)
BY = Criteria(SAMPLING_PX, NoiseModel.of_detector(DETECTOR), THRESHOLDS)
SETTINGS = (ALL, BY)
IMAGE = star(48, 44, flux_e=1e6)
PEAK = np.unravel_index(IMAGE.argmax(), IMAGE.shape)


def frames(image=IMAGE, count=30, **noise):
    return frames_e(image, count, **noise).astype(np.float32)


def moving(count=30):
    shifts = np.random.default_rng(5).normal(0, 0.6, (count, 2))
    image = np.stack([star(48, 44, flux_e=1e6, shift_px=shift) for shift in shifts])
    rng = np.random.default_rng(6)
    return (rng.poisson(image) + rng.normal(0, 1, image.shape)).astype(np.float32)


def places(mask):
    return [tuple(place) for place in np.argwhere(mask).tolist()]


@pytest.mark.slow
def test_the_variance_of_the_prediction_is_that_of_noise():
    prediction = neighbour_prediction(ALL, SAMPLING_PX)
    noise = np.random.default_rng(0).normal(0, 2, (4000, *ALL.shape))
    seen = (noise - prediction.of(noise)).var(axis=0)
    assert seen / prediction.variance(np.full(ALL.shape, 4.0)) == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize(
    "images",
    [frames(), frames(count=3), frames(count=1), moving()],
    ids=["still", "three frames", "one frame", "moving"],
)
def test_a_clean_recording_has_no_bad_pixels_and_no_hits(images):
    assert places(deviant_pixels(images, *SETTINGS)) == []
    assert places(noisy_pixels(images, *SETTINGS)) == []
    if len(images) > 1:
        assert cosmic_hits(images, np.arange(len(images)), *SETTINGS).frame.size == 0


@pytest.mark.parametrize(
    "images", [frames(), frames(count=3), moving()], ids=["still", "three frames", "moving"]
)
@pytest.mark.parametrize(
    ("place", "value"),
    [(PEAK, 0.0), ((PEAK[0] + 2, PEAK[1] - 1), 0.0), ((3, 40), 400.0), ((0, 0), 400.0), ((47, 20), 400.0)],
    ids=["dead at the peak", "dead in the core", "hot in the wing", "hot in the corner", "hot at the edge"],
)
def test_a_pixel_that_differs_from_its_neighbours_is_found_alone(images, place, value):
    images = images.copy()
    images[(slice(None), *place)] = value
    assert places(deviant_pixels(images, *SETTINGS)) == [place]


def test_neighbouring_bad_pixels_are_found_without_the_good_between():
    images = frames()
    wanted = [(PEAK[0], PEAK[1] - 2), (PEAK[0], PEAK[1]), (10, 10), (10, 12), (11, 11)]
    for place in wanted:
        images[(slice(None), *place)] = 0 if place[0] == PEAK[0] else 1000
    assert places(deviant_pixels(images, *SETTINGS)) == sorted(wanted)


def test_a_read_noise_declared_too_small_makes_no_bad_pixels():
    images = frames(read_noise_e=15.0)
    assert places(deviant_pixels(images, *SETTINGS)) == []
    assert places(noisy_pixels(images, *SETTINGS)) == []


@pytest.mark.parametrize(
    "more_e",
    [np.random.default_rng(4).normal(0, 150, 30), 500 * (np.arange(30) % 3 == 0)],
    ids=["", "states"],
)
def test_a_noisy_pixel_and_one_of_two_states_are_found(more_e):
    images = frames()
    images[:, 5, 8] += more_e
    assert places(noisy_pixels(images, *SETTINGS)) == [(5, 8)]


def test_a_stuck_pixel_is_found_by_its_silence():
    adu = frames() / 0.5
    adu[:, 30, 10] = 47.0
    assert places(stuck_pixels(adu, 2.0, THRESHOLDS.stuck_ratio)) == [(30, 10)]


@pytest.mark.parametrize("count", [3, 5, 30])
def test_no_good_pixel_is_stuck(count):
    assert not stuck_pixels(frames(count=count) / 0.5, 2.0, THRESHOLDS.stuck_ratio).any()


def test_a_hot_pixel_of_the_dark_is_bad_and_a_bias_pattern_is_not():
    dark = np.random.default_rng(0).normal(50, 5, ALL.shape)
    dark[12, 13] += 1000
    assert places(hot_in_dark(dark, DETECTOR, THRESHOLDS)) == [(12, 13)]


@pytest.mark.parametrize("images", [frames(), moving()], ids=["still", "moving"])
def test_cosmic_hits_are_found_where_they_are(images):
    images = images.copy()
    wanted = {(3, 10, 10): 500.0, (3, 10, 11): 200.0, (17, 40, 3): 100.0, (20, *PEAK): 40000.0}
    for place, charge in wanted.items():
        images[place] += charge
    hits = cosmic_hits(images, np.arange(len(images)), *SETTINGS)
    assert set(zip(hits.frame.tolist(), hits.row.tolist(), hits.column.tolist(), strict=True)) == {
        tuple(map(int, place)) for place in wanted
    }


def test_a_pixel_hit_again_and_again_is_bad():
    images = frames()
    images[[2, 9, 11, 20], 10, 10] += 500
    images[[5, 6], 40, 3] += 500
    hits = cosmic_hits(images, np.arange(len(images)), *SETTINGS)
    flicker = flickering_pixels(hits, len(images), ALL.shape, fraction=0.05)
    assert places(flicker) == [(10, 10)]
    assert hits.outside(flicker).row.tolist() == [40, 40]


def test_a_replaced_pixel_has_the_value_it_would_have_had():
    spoilt = np.stack([IMAGE, 2 * IMAGE])
    good = ALL.copy()
    for place in [PEAK, (10, 10), (10, 11), (0, 0)]:
        good[place] = False
    spoilt[:, ~good] = -1e6
    filled = BY.filled(spoilt, good)
    assert np.abs(filled[0] - IMAGE).max() < 0.02 * IMAGE.max()
    assert np.abs(filled[1] - 2 * IMAGE).max() < 0.04 * IMAGE.max()
    assert (spoilt[:, ~good] == -1e6).all()


def test_bad_pixels_of_no_images_at_all_are_filled_too():
    """As where every frame of a recording is saturated."""
    good = np.ones((12, 10), dtype=bool)
    good[3, 4] = False
    assert BY.filled(np.empty((0, 12, 10)), good).shape == (0, 12, 10)
