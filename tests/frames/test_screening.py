"""Frames that cannot be used, each with its reason."""

import numpy as np
import pytest
from helpers.sparta_files import counts, frames_e, star

from irlos_pipe.frames import screening
from irlos_pipe.frames.hits import Hits
from irlos_pipe.frames.screening import (
    core_of,
    hit_in_core,
    no_reasons,
    recorder_faults,
    saturated_frames,
    star_faults,
)
from irlos_pipe.stages.ingest.stage import Config

LIMITS = Config().limits()
IMAGE = star(32, 32, flux_e=1e5)


def images(count=12):
    return frames_e(IMAGE, count).astype(np.float32)


def judged(cube, limits=LIMITS):
    return star_faults(cube, no_reasons(len(cube)), limits).tolist()


def only(frame, reason, count=12):
    return [reason if index == frame else "" for index in range(count)]


def test_a_clean_recording_loses_no_frame():
    adu = counts(IMAGE)
    assert recorder_faults(adu, np.arange(len(adu))).tolist() == [""] * len(adu)
    assert judged(images()) == [""] * 12


@pytest.mark.parametrize(
    ("frame", "pixels", "value", "reason"),
    [
        (2, (5, 5), np.nan, screening.NOT_FINITE),
        (2, (5, 5), np.inf, screening.NOT_FINITE),
        (slice(None), (5, 5), np.nan, ""),  # a pixel that never is a number
        (2, (), 0, screening.EMPTY),
        (2, (), 200, screening.EMPTY),
        (2, (), counts(IMAGE, 4)[1], screening.REPEATED_IMAGE),
    ],
)
def test_a_frame_that_the_recorder_spoilt_is_rejected(frame, pixels, value, reason):
    adu = counts(IMAGE, 4)
    adu[(frame, *pixels)] = value
    assert recorder_faults(adu, np.arange(4)).tolist() == ["", "", reason, ""]


def test_saturated_pixels_count_unless_they_are_bad():
    adu = np.zeros((3, 4, 4))
    adu[1, 2, 2] = adu[2, 0, 0] = 65535
    good = np.ones((4, 4), bool)
    good[0, 0] = False
    assert saturated_frames(adu, good, 65535, tolerated_px=0).tolist() == [False, True, False]
    assert not saturated_frames(adu, good, 65535, tolerated_px=1).any()
    assert not saturated_frames(adu, good, None, tolerated_px=0).any()


def test_a_frame_without_the_star_is_rejected():
    cube = images()
    cube[4] = np.random.default_rng(0).normal(0, 1, IMAGE.shape)
    assert judged(cube) == only(4, screening.NO_STAR)


@pytest.mark.parametrize("gradient", [0.0, 1.0])
def test_noise_and_a_gradient_are_no_star(gradient):
    noise = np.random.default_rng(0).normal(0, 1, (20, 32, 32)) + gradient * np.arange(32)
    assert judged(noise.astype(np.float32)) == [screening.NO_STAR] * 20


def test_a_star_too_faint_for_single_frames_is_kept_if_their_median_shows_it():
    cube = frames_e(star(32, 32, flux_e=200), 150, read_noise_e=3.0).astype(np.float32)
    assert screening.star_peaks(cube).snr.min() < LIMITS.star_snr
    assert judged(cube) == [""] * 150


@pytest.mark.parametrize("factor", [0.5, 1.6])
def test_a_frame_of_odd_flux_is_rejected(factor):
    cube = images()
    cube[2] *= factor
    assert judged(cube) == only(2, screening.FLUX)


@pytest.mark.parametrize("place", [0, 5, 12])
@pytest.mark.parametrize("combine", ["mean", "sum", "median", "mean of five"])
def test_a_plane_that_is_made_of_the_others_is_named_wherever_it_stands(place, combine):
    cube = np.rint(images())
    made = np.rint({"mean": cube.mean(0), "sum": cube.sum(0), "median": np.median(cube, 0)}.get(
        combine, cube[:5].mean(0)
    ))  # fmt: skip
    with_it = np.insert(cube, place, made, axis=0)
    assert judged(with_it) == only(place, screening.COMBINED, 13)


@pytest.mark.parametrize("factor", [0.75, 1.0, 1.25])
def test_an_exposure_where_the_star_stands_as_in_the_mean_is_none_that_is_made_of_others(factor):
    """Of a drifting star without read noise; the middle frame is the one most like the mean."""
    rng = np.random.default_rng(2)
    shifts = np.linspace(-1, 1, 13)
    cube = np.array([rng.poisson(star(32, 32, flux_e=1e8, shift_px=(s, 0.5 * s))) for s in shifts])
    cube[6] = rng.poisson(factor * star(32, 32, flux_e=1e8))
    assert judged(cube.astype(np.float32)) == [""] * 13


def test_many_hits_reject_a_frame_only_in_the_core():
    peak = np.unravel_index(IMAGE.argmax(), IMAGE.shape)
    number = LIMITS.core_hits_px + 1
    hits = Hits(
        frame=np.repeat([1, 2, 3], [number, number, number - 1]),
        row=np.repeat([peak[0], 0, peak[0]], [number, number, number - 1]),
        column=np.repeat([peak[1], 0, peak[1]], [number, number, number - 1]),
    )
    assert hit_in_core(hits, core_of(IMAGE, LIMITS), 4, LIMITS).tolist() == [False, True, False, False]
