"""Frames as sums of reads, with sky and stripes. Truth: moments of the distributions (analysis)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.simulated_scenes import FACILITY

from irlos_pipe.simulate import SceneError
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.detector import DetectorModel, Pattern
from irlos_pipe.simulate.exposure import exposures
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.motion import Motion
from irlos_pipe.simulate.readout import Readout, electrons
from irlos_pipe.simulate.scene import Sampling, Scene

WINDOW = (30, 34)
READS = 8
BENIGN = Scene("test", FACILITY, (Band(1600.0, 20.0),), (0,), 1, 0.04, window=WINDOW)


def scene(effects: dict | None = None, *, sky_e_per_s: float = 0.0, **detector) -> Scene:
    model = DetectorModel(**{"read_s": 0.04 / READS, "e_per_adu": 0.5} | detector)
    return replace(BENIGN, effects=effects or {}, detector=model, sky_e_per_s=sky_e_per_s)


def level(value_e: float, frames: int) -> np.ndarray:
    return np.full((frames, *WINDOW), float(value_e))


def test_a_frame_has_the_light_of_all_its_reads_and_the_read_noise_of_each():
    for value_e in (0.0, 200.0):
        readout = Readout.of(scene(excess_noise_factor=1.25), level(value_e, 1)[0])
        raw = readout.frames_adu(level(value_e, 300), np.random.default_rng(1))
        assert raw.dtype == np.int32
        signal_e = (raw - READS * readout.pedestal_adu) * 0.5
        assert signal_e.mean() == pytest.approx(value_e, abs=0.05)  # 306 000 values of ≤ 16 e-
        assert signal_e.var() == pytest.approx(1.25 * value_e + READS * 1.0, rel=0.01)


def test_electrons_have_the_noise_of_the_raw_frames_and_of_the_sky():
    sky = scene(sky_e_per_s=500.0, excess_noise_factor=1.25)
    signal_e = electrons(sky, level(0.0, 300), np.random.default_rng(2))
    assert signal_e.mean() == pytest.approx(500 * 0.04, rel=0.005)
    assert signal_e.var() == pytest.approx(1.25 * 20 + READS, rel=0.01)


def test_the_dark_of_many_reads_is_the_mean_of_frames_without_light():
    model = scene(dark_e_per_s=2000.0, flat_rms=0.05)
    readout, frames = Readout.of(model, level(0, 1)[0]), level(0, 400)
    drawn = readout.frames_adu(frames, np.random.default_rng(3))
    dark = readout.dark_adu(np.random.default_rng(4))
    # the mean of 400 frames and the dark, of 64, err by the noise of a frame over the root of their numbers
    sigma = np.sqrt(drawn.var(axis=0) * (1 / 400 + 1 / 64))
    assert np.std((drawn.mean(axis=0) - dark) / sigma) == pytest.approx(1, abs=0.08)


def test_levels_of_effects_are_those_of_a_frame_whatever_the_reads():
    effects = {
        "background_gradient": {"level_e": 80.0},
        "bad_pixels": {"pixels": [[3, 4]], "kind": "hot", "level_e": 4000.0},
    }
    mean_e = electrons(scene(effects), level(0.0, 200), np.random.default_rng(5)).mean(axis=0)
    assert np.median(mean_e) == pytest.approx(80, abs=1)
    assert mean_e[3, 4] == pytest.approx(4080, rel=0.01)


def test_a_bend_stated_at_the_peak_of_a_frame_does_not_depend_on_the_reads():
    effects, light = {"detector_nonlinearity": {"fraction_at_peak": 0.1}}, level(1e6, 1)
    for read_s in (None, 0.005):
        image = electrons(scene(effects, read_s=read_s), light, np.random.default_rng(6))
        assert image.mean() == pytest.approx(0.9e6, rel=1e-3)


def test_reads_that_do_not_fill_the_exposure_are_refused_in_one_line():
    with pytest.raises(SceneError, match=r"do not add up to exposure_s = 0\.04") as error:
        scene(read_s=0.007)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("axis", "alike", "apart"), [("rows", 2, 1), ("columns", 1, 2)])
@pytest.mark.parametrize("period_px", [None, 7.0])
def test_stripes_have_their_size_and_are_the_same_along_their_axis(axis, alike, apart, period_px):
    drawn = np.broadcast_to(
        Pattern(3.0, axis, period_px).drawn_e((4000, *WINDOW), np.random.default_rng(7)), (4000, *WINDOW)
    )
    assert drawn.std() == pytest.approx(3.0, rel=0.02)
    assert np.ptp(drawn, axis=alike).max() == 0
    assert np.ptp(drawn, axis=apart).min() > 0


def test_one_over_f_noise_has_the_correlation_of_its_spectrum():
    stripes = Pattern(1.0).drawn_e((20000, *WINDOW), np.random.default_rng(8))[..., 0]
    size = WINDOW[0]
    f = np.arange(1, size + 1) / (2 * size)  # of a series twice as long, 1/f, Nyquist's once
    power = np.where(f < 0.5, 2, 1) / f
    for lag in (1, 5):
        expected = np.sum(power * np.cos(2 * np.pi * f * lag)) / power.sum()
        assert np.mean(stripes[:, 3] * stripes[:, 3 + lag]) == pytest.approx(expected, abs=0.03)


def test_stripes_of_independent_reads_add_up_to_those_of_a_frame():
    effects = {"correlated_noise": {"e_rms": 20.0, "axis": "columns"}}
    signal_e = electrons(scene(effects), level(0.0, 1500), np.random.default_rng(9))
    columns = signal_e.mean(axis=1)
    assert columns.std() == pytest.approx(np.hypot(20.0, np.sqrt(READS / WINDOW[0])), rel=0.05)


def test_exposures_of_two_milliseconds_have_no_negative_light():
    short = replace(
        BENIGN,
        frames=6,
        exposure_s=0.002,
        frame_rate_hz=500.0,
        sky=Sky(0.35),
        motion=Motion(7.0),
        window=(64, 64),
        sampling=Sampling(pupil_samples=96, points_per_band=1),
        seed=(12,),
    )
    for exposure in exposures(short):
        assert exposure.mean_e.min() >= 0
        assert exposure.mean_e.sum() == pytest.approx(short.photons, rel=0.2)
