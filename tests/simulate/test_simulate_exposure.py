"""How the simulator hands out frames: repeatable, one by one, independent of how many there are.

Truth: repetition, and finer sampling in time and wavelength.
"""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from helpers import optics_cases as cases
from helpers.simulated_scenes import FACILITY, image, of_light, scene, worst
from scipy.signal import welch

from irlos_pipe.conventions import bands
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.camera import Camera, pupil_of
from irlos_pipe.simulate.exposure import expose, exposures, telescope_of
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.mirror import Actuators, Mirror
from irlos_pipe.simulate.motion import Motion, MotionSeries
from irlos_pipe.simulate.scene import Sampling, Scene

QUICK = {
    "sky": Sky(0.5),
    "motion": Motion(),
    "window": (24, 24),
    "frames": 3,
    "exposure_s": 0.04,
    "sampling": Sampling(pupil_samples=48, points_per_band=1),
}


BENCH = QUICK | {"sky": None, "motion": None}


def test_modes_of_the_truth_are_those_of_the_scene_whatever_lies_beyond_them():
    """Over an obscured pupil Noll 37 looks like spherical aberration, of which this scene has none."""
    ncpa_nm = {5: 20.0, 37: 60.0, 56: 40.0}
    exposed = expose(scene(**BENCH, ncpa_nm=ncpa_nm))
    stated_nm = [20.0 if noll == 5 else 0.0 for noll in range(2, 32)]
    assert exposed.zernike_nm == pytest.approx(np.tile(stated_nm, (3, 1)), abs=1e-6)
    assert list(exposed.mean_zernike_nm().values()) == pytest.approx(stated_nm, abs=1e-6)
    fitted_nm = exposed.telescope.fit_zernike_nm(exposed.mean_opd_nm, 31)
    assert abs(fitted_nm[11 - 2]) > 1.0  # of the same wavefront, had the scene not stated its modes


def test_the_same_seed_gives_the_same_bits_and_another_one_another_sky():
    first, second, other = (expose(scene(**QUICK, **seed)) for seed in ({}, {}, {"seed": (20, 25)}))
    assert np.array_equal(first.mean_e, second.mean_e)
    assert np.array_equal(first.mean_opd_nm, second.mean_opd_nm)
    assert np.abs(first.zernike_nm - other.zernike_nm).max() > 1


def test_sky_and_motion_are_drawn_apart():
    with_motion, without = expose(scene(**QUICK)), expose(scene(**QUICK | {"motion": None}))
    assert np.allclose(with_motion.zernike_nm[:, 2:], without.zernike_nm[:, 2:], atol=1e-3)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_number_of_frames():
    def peak_bytes(frames: int) -> int:
        tracemalloc.start()
        for _ in exposures(scene(**QUICK | {"frames": frames})):
            pass
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    peak_bytes(2)  # fills the caches
    assert peak_bytes(40) < 1.02 * peak_bytes(4)


@pytest.mark.slow
def test_the_default_step_makes_frames_scatter_hardly_more_than_continuous_exposure():
    def scatter_nm(step_s: float) -> float:
        sampling = Sampling(pupil_samples=32, points_per_band=1, step_s=step_s)
        cube = expose(scene(sky=Sky(0.5), frames=120, window=(4, 4), sampling=sampling))
        return float(np.sqrt(cube.zernike_nm[:, 2:].var(axis=0).mean()))

    assert 1.0 < scatter_nm(Sampling().step_s) / scatter_nm(0.002) < 1.1


@pytest.mark.slow
@pytest.mark.parametrize("band", [Band(1600.0, 20.0), Band(1215.0, 58.0), Band(1625.0, 84.0)])
def test_the_default_wavelengths_resolve_the_bands(band):
    few, many = (
        image(bands=(band,), window=(64, 64), sampling=Sampling(points_per_band=points))
        for points in (Sampling().points_per_band, 15)
    )
    assert worst(few, many) < 1e-5


# Image motion of the simulator.
# Truth: periodograms of long series against the given lines and wander; the mean of many instantaneous
# images for motion within a sub-exposure.


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


# A deformable mirror in the simulator.
# Truth: formulas of the Zernike polynomials, turned and shifted by hand.


FINE = Mirror(Actuators(cases.FACILITY.pupil.diameter_m, 0.25))
SMOOTH = Mirror(replace(FINE.actuators, coupling=0.7))  # makes modes to a few parts in a thousand
SCENE = Scene("mirror", cases.FACILITY, (Band(bands.NARROW_H.centre_nm, 20.0),), (1,), 1, 0.1)
TELESCOPE = telescope_of(SCENE)


def test_an_aligned_mirror_makes_the_modes_that_it_is_sent():
    sent_nm = {4: 100.0, 7: -40.0, 22: 20.0}
    left_nm = replace(FINE, offsets_nm=sent_nm).opd_nm(TELESCOPE) - TELESCOPE.opd_nm(sent_nm)
    lit = TELESCOPE.transmission > 0
    assert left_nm[lit].std() < 0.02 * np.linalg.norm(list(sent_nm.values()))


def test_a_shifted_mirror_makes_tilt_of_defocus():
    # √3 (2 ((x − s)² + y²) − 1) = Z4 − 2 √3 s · 2x + constant, s in radii of the pupil.
    shift_m = 0.02 * FINE.actuators.diameter_m / 2
    mirror = replace(SMOOTH, shift_m=(shift_m, -2 * shift_m), offsets_nm={4: 100.0})
    found_nm = TELESCOPE.fit_zernike_nm(mirror.opd_nm(TELESCOPE), 45)
    slope_nm = 100 * 2 * np.sqrt(3) * 0.02
    assert found_nm[:3] == pytest.approx([-slope_nm, 2 * slope_nm, 100.0], abs=0.5)


@pytest.mark.slow
def test_minus_the_aberration_on_the_mirror_gives_the_image_of_a_perfect_star():
    perfect, aberrated = expose(SCENE), replace(SCENE, ncpa_nm={4: 150.0, 8: -60.0})
    corrected = expose(replace(aberrated, mirror=replace(FINE, offsets_nm={4: -150.0, 8: 60.0})))
    worse = expose(replace(aberrated, mirror=FINE))
    peak = float(perfect.mean_e.max())
    assert corrected.mean_e == pytest.approx(perfect.mean_e, abs=0.002 * peak)
    assert worse.mean_e.max() < 0.8 * peak
    assert worse.mean_zernike_nm()[4] == pytest.approx(150.0, abs=1e-6)  # a mirror at rest is flat
    assert abs(corrected.mean_zernike_nm()[4]) < 1.0
