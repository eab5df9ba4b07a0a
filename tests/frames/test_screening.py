"""Frames that cannot be used, each with its reason."""

from functools import cache

import numpy as np
import pytest
from astropy.io import fits
from helpers import paths
from helpers.sparta_files import counts, frames_e, star

from irlos_pipe.frames import screening
from irlos_pipe.frames.bad_pixels import Thresholds
from irlos_pipe.frames.cleaning import clean
from irlos_pipe.frames.recording import FRAMES, PROFILE, SIDECAR, Detector, RawFrames
from irlos_pipe.frames.screening import (
    Hits,
    Limits,
    core_of,
    hit_in_core,
    no_reasons,
    recorder_faults,
    saturated_frames,
    star_faults,
)
from irlos_pipe.frames.told import EXCESS, GAIN, READ_NOISE, MeasuredNoise, believed, constants
from irlos_pipe.stages.ingest.stage import Config

SAMPLING_PX = 3.81
OBSCURATION = 0.49
ACROSS = 48  # samples across the pupil
SUB_EXPOSURES = 3


def speckle_cube(frames: int, size: int = 64, seed: int = 11) -> np.ndarray:
    """Return frames (frames, size, size) [e-] of a star with 1e7 electrons inside the window.

    The phase within a frame has an RMS of 0.5 rad, half of its variance static; the changing part has a
    correlation of 0.7 from one exposure to the next. The read noise is 15 e-.
    """
    rng = np.random.default_rng(seed)
    static, moving = _screen(rng), _screen(rng)
    images = np.zeros((frames, size, size))
    for image in images:
        for _ in range(SUB_EXPOSURES):
            moving = 0.7 * moving + np.sqrt(1 - 0.7**2) * _screen(rng)
            image += _intensity((static + moving) * 0.5 / np.sqrt(2), size)
    images *= 1e7 / images.sum(axis=(1, 2)).mean()
    return rng.poisson(images) + rng.normal(0, 15.0, images.shape)


def _pupil() -> np.ndarray:
    y, x = (np.indices((ACROSS, ACROSS)) - (ACROSS - 1) / 2) / ACROSS
    radius = np.hypot(y, x)
    return ((radius <= 0.5) & (radius >= 0.5 * OBSCURATION)).astype(float)


def _screen(rng: np.random.Generator) -> np.ndarray:
    """Phase of unit RMS over the pupil with a power spectrum that falls like f^-2."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(2 * ACROSS), np.fft.fftfreq(2 * ACROSS)))
    frequency[0, 0] = np.inf
    white = np.fft.fft2(rng.normal(size=frequency.shape))
    phase = np.fft.ifft2(white / frequency).real[:ACROSS, :ACROSS]
    inside = _pupil() > 0
    phase -= phase[inside].mean()
    return phase / phase[inside].std()


def _intensity(phase: np.ndarray, size: int) -> np.ndarray:
    across = (np.arange(ACROSS) - (ACROSS - 1) / 2) / ACROSS
    transform = np.exp(-2j * np.pi * np.outer(np.arange(size) - (size - 1) / 2, across) / SAMPLING_PX)
    return np.abs(transform @ (_pupil() * np.exp(1j * phase)) @ transform.T) ** 2


LIMITS = Config().part(Limits)
IMAGE = star(32, 32, flux_e=1e5)


def images(count=12):
    return frames_e(IMAGE, count).astype(np.float32)


def judged(cube, limits=LIMITS):
    return star_faults(cube, no_reasons(len(cube)), limits).tolist()


def only(frame, reason, count=12):
    return [reason if index == frame else "" for index in range(count)]


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


@pytest.mark.parametrize("across_px", [20, 40, 56])
def test_a_star_spread_over_many_pixels_is_one_although_none_of_them_stands_out(across_px):
    """A pupil far out of focus: 1e5 electrons in a ring, noise of 20 e- in every pixel."""
    y, x = np.indices((64, 64)) - 31.5
    disc = (np.hypot(y, x) < across_px / 2) & (np.hypot(y, x) > 0.15 * across_px / 2)
    sharp = 1e5 / 18 * np.exp(-(np.hypot(y, x) ** 2) / 6)
    planes = np.array([disc * 1e5 / disc.sum(), sharp, sharp, sharp, np.zeros((64, 64))])
    planes += np.random.default_rng(1).normal(0, 20, planes.shape)
    assert judged(planes.astype(np.float32)) == ["", "", "", "", screening.NO_STAR]


@pytest.mark.parametrize("gradient", [0.0, 1.0])
def test_noise_and_a_gradient_are_no_star(gradient):
    noise = np.random.default_rng(0).normal(0, 1, (20, 32, 32)) + gradient * np.arange(32)
    assert judged(noise.astype(np.float32)) == [screening.NO_STAR] * 20


@pytest.mark.parametrize("factor", [0.5, 1.6])
def test_a_frame_of_odd_flux_is_rejected(factor):
    cube = images()
    cube[2] *= factor
    assert judged(cube) == only(2, screening.FLUX)


def test_a_plane_of_focus_whose_light_leaves_the_window_is_no_frame_of_odd_flux():
    cube = images()
    cube[6:] *= 0.5
    cube[8] *= 2.0
    plane = np.repeat([0.0, 300.0], 6)
    assert star_faults(cube, no_reasons(12), LIMITS, plane).tolist() == only(8, screening.FLUX)


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
    number = LIMITS.max_core_hits_px + 1
    hits = Hits(
        frame=np.repeat([1, 2, 3], [number, number, number - 1]),
        row=np.repeat([peak[0], 0, peak[0]], [number, number, number - 1]),
        column=np.repeat([peak[1], 0, peak[1]], [number, number, number - 1]),
    )
    assert hit_in_core(hits, core_of(IMAGE, LIMITS), 4, LIMITS).tolist() == [False, True, False, False]


# Speckles of a bright star are no defects; clipped, hot and hit pixels among them are found.


GAIN_E = 4.0
PEAK = (32, 32)
PHARO = paths.SHARED / "realdata" / "palomar_pharo" / "ca1.fits"
needs_pharo = pytest.mark.skipif(not PHARO.is_file(), reason="the recording of PHARO is not there")
PHARO_SAMPLING_PX = 3.81  # 2.145 um, 4.646 m, 25 mas


@cache
def cube_e() -> np.ndarray:
    return speckle_cube(40)


@cache
def pharo_e() -> np.ndarray:
    return fits.getdata(PHARO).astype(np.float64) * GAIN_E


def cleaned(images_e, sampling_px=SAMPLING_PX, read_noise_e=15.0):
    raw = RawFrames(adu=(images_e / GAIN_E).astype(np.float32), frame_counter=np.arange(len(images_e)))
    config = Config()
    detector = Detector(e_per_adu=GAIN_E, read_noise_e=read_noise_e)
    return clean(raw, detector, sampling_px, config.part(Thresholds), config.part(Limits))


@pytest.mark.parametrize("sampling_px", [1.3, 2.0])
def test_undersampled_frames_without_a_dark_have_no_noise_of_a_dark(sampling_px):
    """A star with all its light in four pixels, which no neighbours predict."""
    star_e = np.full((32, 32), 10.0)
    star_e[15:17, 15:17] = 1e5
    star_e[::2, ::2] += 5
    frames_e = np.random.default_rng(3).poisson(star_e, (20, 32, 32)).astype(float)
    assert cleaned(frames_e, sampling_px, read_noise_e=1.0).dark_variance_e2 == 0


def bad(result):
    return {tuple(place) for place in np.argwhere(~result.good).tolist()}


def hits(result):
    found = result.hits
    return set(zip(found.frame.tolist(), found.row.tolist(), found.column.tolist(), strict=True))


def test_speckles_are_neither_bad_pixels_nor_hits_nor_noise():
    """What the pedestal takes of the halo leaves its photon noise in the floor."""
    result = cleaned(cube_e())
    assert (bad(result), hits(result), result.used.all()) == (set(), set(), True)
    noise, halo_e = result.noise, result.background.pedestal_adu * GAIN_E
    assert noise.floor_e2 == pytest.approx(15.0**2 + halo_e, rel=0.05)
    assert noise.excess_noise_factor == pytest.approx(1.0, abs=0.05)


def test_hits_at_the_core_on_the_ring_and_in_the_wings_are_found_alone():
    """A fifth of the signal where there is much, 15 times the noise elsewhere."""
    images = cube_e().copy()
    wanted = {(3, *PEAK), (8, 30, 32), (14, 33, 31), (20, 32, 39), (25, 25, 32), (30, 8, 50), (33, 58, 12)}
    for place in wanted:
        signal = np.median(images[:, place[1], place[2]])
        images[place] += max(0.2 * signal, 15 * np.sqrt(max(signal, 0) + 15**2))
    result = cleaned(images)
    assert hits(result) == wanted
    assert bad(result) == set()
    assert result.used.all()


def test_a_clipped_peak_costs_its_pixels_and_no_frame():
    """Levels of their own for two pixels: no common level of saturation."""
    images = cube_e().copy()
    for (row, column), quantile in {(32, 32): 0.3, (32, 31): 0.6}.items():
        images[:, row, column] = np.minimum(
            images[:, row, column], np.quantile(images[:, row, column], quantile)
        )
    result = cleaned(images)
    assert {(32, 32), (32, 31)} <= bad(result)
    assert np.argwhere(result.clipped).tolist() == [[32, 31], [32, 32]]
    assert result.used.all()


def test_what_is_told_stands_and_what_is_only_assumed_gives_way():
    """Truth: 2 e-/ADU and 15 e-; with the 4 e-/ADU assumed, slope and floor come out 2 and 4 times higher."""
    noise = MeasuredNoise(900.0, 5.0, 2.0, 0.01)
    detector = Detector(e_per_adu=4.0, read_noise_e=1.0)
    assumed, sources = believed(detector, {GAIN: PROFILE, READ_NOISE: PROFILE}, noise)
    assert (assumed.e_per_adu, assumed.read_noise_e) == (pytest.approx(2.0), pytest.approx(15.0))
    assert sources == {GAIN: FRAMES, READ_NOISE: FRAMES}
    told = {GAIN: SIDECAR, READ_NOISE: SIDECAR, EXCESS: SIDECAR}
    assert believed(detector, told, noise) == (detector, told)
    assert all(one.contradicted for one in constants(detector, told, noise).values())


@pytest.mark.parametrize(("measured", "excess"), [(1.6, 1.6), (0.98, 1.0), (0.8, 1.25)])
def test_an_excess_noise_of_the_profile_gives_way_to_frames_where_the_gain_is_told(measured, excess):
    """No detector is quieter than the photons; a slope far below 1 contradicts the gain that was told."""
    detector = Detector(e_per_adu=0.5, read_noise_e=1.0, excess_noise_factor=1.25)
    noise = MeasuredNoise(1.0, 0.1, measured, 0.01)
    assert believed(detector, {GAIN: SIDECAR, EXCESS: PROFILE}, noise)[0].excess_noise_factor == excess


@needs_pharo
def test_every_frame_of_pharo_is_kept_and_what_is_masked_in_its_core_is_clipped():
    result = cleaned(pharo_e(), PHARO_SAMPLING_PX, 17.0)
    assert result.used.all()
    core = {place for place in bad(result) if max(abs(place[0] - 32), abs(place[1] - 32)) <= 4}
    assert {(32, 31), (32, 32), (33, 32)} <= core <= {(31, 32), (32, 31), (32, 32), (33, 31), (33, 32)}


@needs_pharo
def test_defects_put_into_pharo_are_found():
    images = pharo_e().copy()
    before = cleaned(images, PHARO_SAMPLING_PX, 17.0)
    hot = {(25, 33), (12, 14)}
    hit = {(4, 40, 32), (60, 10, 48), (88, 50, 20)}
    for place in hot:
        images[:, *place] += max(0.7 * np.median(images[:, *place]), 300.0)
    for place in hit:
        images[place] += max(0.7 * images[place], 1000.0)
    result = cleaned(images, PHARO_SAMPLING_PX, 17.0)
    assert bad(result) - bad(before) == hot
    assert hit <= hits(result)
