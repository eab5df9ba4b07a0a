"""Speckles of a bright star are no defects; clipped, hot and hit pixels among them are found."""

from functools import cache

import numpy as np
import pytest
from astropy.io import fits
from helpers import paths
from helpers.speckle_cubes import SAMPLING_PX, speckle_cube

from irlos_pipe.frames.cleaning import clean
from irlos_pipe.frames.measured_noise import MeasuredNoise
from irlos_pipe.frames.recording import FRAMES, PROFILE, SIDECAR, Detector, RawFrames
from irlos_pipe.frames.told import EXCESS, GAIN, READ_NOISE, believed, constants
from irlos_pipe.stages.ingest.stage import Config

GAIN_E = 4.0
PEAK = (32, 32)
PHARO = paths.SHARED / "realdata" / "palomar_pharo" / "ca1.fits"
needs_pharo = pytest.mark.skipif(not PHARO.is_file(), reason="the recording of PHARO is not there")
PHARO_SAMPLING_PX = 3.81  # 2.145 um, 4.646 m, 25 mas


@cache
def cube_e() -> np.ndarray:
    return speckle_cube(40, seed=11)


@cache
def pharo_e() -> np.ndarray:
    return fits.getdata(PHARO).astype(np.float64) * GAIN_E


def cleaned(images_e, sampling_px=SAMPLING_PX, read_noise_e=15.0):
    raw = RawFrames(adu=(images_e / GAIN_E).astype(np.float32), frame_counter=np.arange(len(images_e)))
    config = Config()
    detector = Detector(e_per_adu=GAIN_E, read_noise_e=read_noise_e)
    return clean(raw, detector, sampling_px, config.thresholds(), config.limits())


def bad(result):
    return {tuple(place) for place in np.argwhere(~result.good).tolist()}


def hits(result):
    found = result.hits
    return set(zip(found.frame.tolist(), found.row.tolist(), found.column.tolist(), strict=True))


def test_speckles_are_neither_bad_pixels_nor_hits():
    result = cleaned(cube_e())
    assert (bad(result), hits(result), result.used.all()) == (set(), set(), True)


def test_speckles_are_no_noise():
    """What the pedestal takes of the halo leaves its photon noise in the floor."""
    result = cleaned(cube_e())
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
    assert all(one.contradicted for one in constants(detector, told, noise))


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
