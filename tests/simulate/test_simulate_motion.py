"""Image motion of the simulator.

Truth: periodograms of long series against the given lines and wander; the mean of many instantaneous
images for motion within a sub-exposure.
"""

import numpy as np
import pytest
from helpers.simulated_scenes import FACILITY, image, of_light, scene, worst
from scipy.signal import welch

from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.camera import Camera, pupil_of
from irlos_pipe.simulate.exposure import expose
from irlos_pipe.simulate.motion import Motion, MotionSeries
from irlos_pipe.simulate.scene import Sampling

RATE_HZ = 400.0
COARSE = Sampling(pupil_samples=64, points_per_band=1)
UT4_LINES = FACILITY.vibration_lines
UT4_LINES_HZ = (6.0, 8.5, 10.0, 16.0, 24.2, 45.5, 48.3, 72.5, 96.7)  # telemetry of ERIS


@pytest.fixture(scope="module")
def series_mas():
    """Twenty minutes of the default motion, (steps, 2)."""
    return MotionSeries(Motion(), UT4_LINES, np.random.default_rng(8)).next_mas(
        1 / RATE_HZ, int(1200 * RATE_HZ)
    )


@pytest.mark.slow
def test_the_long_term_rms_per_axis_is_seven_mas(series_mas):
    assert np.allclose(series_mas.std(axis=0), 7.0, rtol=0.03)
    assert np.allclose(series_mas.mean(axis=0), 0.0, atol=0.15)
    assert abs(np.corrcoef(series_mas.T)[0, 1]) < 0.03


@pytest.mark.slow
def test_the_motion_has_the_vibration_lines_of_ut4(series_mas):
    assert tuple(hz for hz, *_ in UT4_LINES) == UT4_LINES_HZ
    f, power = welch(series_mas, RATE_HZ, nperseg=8192, axis=0)
    for axis in (0, 1):
        expected = expected_psd(f, axis)
        for hz in UT4_LINES_HZ:
            line = np.abs(f - hz) < 0.5
            assert np.isclose(power[line, axis].sum(), expected[line].sum(), rtol=0.2), (hz, axis)


def expected_psd(f: np.ndarray, axis: int) -> np.ndarray:
    """One-sided PSD [mas²/Hz] of the default motion: Lorentzians of the given variances and widths."""
    lines = [(hz, shares[axis], 1.0) for hz, *shares in UT4_LINES]
    wander = (0.0, 1 - sum(share for _, share, _ in lines), 1 / (2 * np.pi * 4.0))
    total = np.zeros_like(f)
    for hz, share, lifetime_s in [*lines, wander]:
        for offset_hz in (f - hz, f + hz):
            total += 2 * 49 * share * lifetime_s / (1 + (2 * np.pi * offset_hz * lifetime_s) ** 2)
    return total


def test_the_wander_is_slower_than_its_corner():
    series = MotionSeries(Motion(wander_hz=4.0), (), np.random.default_rng(2))
    f, power = welch(series.next_mas(1 / RATE_HZ, 200_000)[:, 0], RATE_HZ, nperseg=4096)
    plateau = power[(f > 0.1) & (f < 0.8)].mean()
    for hz in (4.0, 12.0, 40.0):
        found = power[np.abs(f - hz) < 0.1 * hz].mean()
        assert np.isclose(found / plateau, 1 / (1 + (hz / 4.0) ** 2), rtol=0.15), hz


@pytest.mark.parametrize("sky", [None, Sky(1e-4, wfe_nm=0.1)])
def test_motion_within_a_sub_exposure_blurs_it(sky):
    moving = scene(motion=Motion(rms_mas=10.0), sky=sky, sampling=COARSE, window=(32, 32))
    found = of_light(expose(moving), moving)
    pupil, times = pupil_of(moving), moving.subexposures
    track_mas = MotionSeries(moving.motion, UT4_LINES, moving.rng("motion")).next_mas(0.1 / 80, 80)
    static_nm = pupil.opd_nm(moving.ncpa_nm) + pupil.opd_nm(moving.diversity_nm)
    resting = Camera(scene(sampling=COARSE, window=(32, 32)), pupil)
    expected = resting.images(static_nm + pupil.tilts_nm(track_mas)).mean(axis=0)
    assert worst(found, expected) < 1e-4
    middles_mas = track_mas.reshape(10, 8, 2).mean(axis=1)
    assert times == (10 if sky else 1)
    assert worst(resting.images(static_nm + pupil.tilts_nm(middles_mas)).mean(axis=0), expected) > 0.005


def test_the_truth_follows_the_mean_position_of_every_frame():
    moving = scene(motion=Motion(), frames=3, ncpa_nm={}, sampling=COARSE)
    exposed = expose(moving)
    track_mas = MotionSeries(moving.motion, UT4_LINES, moving.rng("motion")).next_mas(0.01 / 8, 240)
    expected_mas = track_mas.reshape(3, 80, 2).mean(axis=1)
    nm_per_mas = np.deg2rad(1 / 3.6e6) * 8.0 / 4 * 1e9
    assert np.allclose(exposed.zernike_nm[:, :2], expected_mas * nm_per_mas, atol=1e-3)
    resting = image(ncpa_nm={}, sampling=COARSE)
    for image_e, (x_mas, y_mas) in zip(exposed.mean_e, expected_mas, strict=True):
        moved_px = peak_of(image_e) - peak_of(resting)
        assert np.allclose(moved_px, np.array([y_mas, x_mas]) / 9.7, atol=0.1)


def peak_of(frame: np.ndarray) -> np.ndarray:
    """Row and column of the brightest light, weighted with its square [px]."""
    weight = frame.astype(float) ** 2
    return np.array([np.sum(grid * weight) for grid in np.indices(frame.shape)]) / weight.sum()
