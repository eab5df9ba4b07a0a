"""Noise of the dark image, seen in the frames; truth by Monte Carlo with known variances."""

import numpy as np
import pytest

from irlos_pipe.frames.measured_noise import dark_variance_e2, measure_noise
from irlos_pipe.frames.neighbour_prediction import neighbour_prediction
from irlos_pipe.frames.noise import NoiseModel

ALL_GOOD = np.ones((64, 64), dtype=bool)


def star_e(peak_e: float = 1e4) -> np.ndarray:
    """An Airy-like image of 4.2 pixels per λ/D with wings, by the Fourier transform of a disc."""
    y, x = np.indices((256, 256)) - 128
    field = np.fft.fftshift(np.fft.fft2(np.hypot(x, y) < 256 / 4.2 / 2))
    image = (abs(field) ** 2)[96:160, 96:160]
    return peak_e * image / image.max()


def frames_e(dark_sigma_e: float, count: int = 60, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    photons = rng.poisson(star_e(), (count, 64, 64))
    return photons + rng.normal(0, 1.0, photons.shape) - rng.normal(0, dark_sigma_e, (64, 64))


@pytest.mark.parametrize("sigma_e", [0.2, 0.5, 2.0])
def test_the_noise_of_the_dark_is_found_in_the_frames(sigma_e):
    """To the error of eight draws, a tenth, and what the star's wings add, less than 0.01 e-²."""
    found = np.mean([dark_variance_e2(frames_e(sigma_e, seed=s), ALL_GOOD, 100.0) for s in range(8)])
    assert found == pytest.approx(sigma_e**2, rel=0.15, abs=0.01)


@pytest.mark.parametrize("level_e", [-3.0, 0.0, 3.0])
def test_a_background_that_is_off_by_some_electrons_does_not_change_the_photon_transfer(level_e):
    """Ten frames of a gain as told: a slope of 1 to five of its errors, and less of an error than a tenth."""
    prediction = neighbour_prediction(ALL_GOOD, 4.2)
    images = frames_e(0.0, count=10, seed=3) + level_e
    found = measure_noise(images, ALL_GOOD, prediction, NoiseModel(1.0, 1.0))
    assert 0 < found.excess_noise_error < 0.1
    assert abs(found.excess_noise_factor - 1) < 5 * found.excess_noise_error
    assert np.isfinite(found.floor_error_e2) and found.floor_e2 >= 0


def on_sky_e(flux_e: float, count: int = 40) -> np.ndarray:
    """A star whose halo and centre change from frame to frame, with 9 e- of read noise, (count, 64, 64)."""
    rng = np.random.default_rng(7)
    shifted = [np.roll(star_e(flux_e), rng.integers(-2, 3, 2), (0, 1)) for _ in range(count)]
    seen = np.stack(shifted) * rng.normal(1.0, 0.1, (count, 1, 1))
    return rng.poisson(seen) + rng.normal(0, 9.0, seen.shape)


@pytest.mark.parametrize("unit", [1e-6, 1e-5, 1e-3, 0.03, 30.0, 1e3, 1e6])
@pytest.mark.parametrize("flux_e", [300.0, 1e5])
def test_frames_in_another_unit_have_the_same_noise_in_that_unit(flux_e, unit):
    """The slope is proportional to the unit, the floor to its square, to the rounding of the frames."""
    prediction = neighbour_prediction(ALL_GOOD, 4.2)
    images, told = on_sky_e(flux_e).astype(np.float32), NoiseModel(1.0, 81.0)
    found = measure_noise(images, ALL_GOOD, prediction, told)
    scaled = measure_noise((images * unit).astype(np.float32), ALL_GOOD, prediction, told)
    assert found.floor_e2 > 0 and found.excess_noise_factor > 0
    assert scaled.excess_noise_factor / unit == pytest.approx(found.excess_noise_factor, rel=1e-4)
    assert scaled.excess_noise_error / unit == pytest.approx(found.excess_noise_error, rel=1e-4)
    assert scaled.floor_e2 / unit**2 == pytest.approx(found.floor_e2, rel=1e-4)
    assert scaled.floor_error_e2 / unit**2 == pytest.approx(found.floor_error_e2, rel=1e-4)


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_the_noise_is_that_of_the_frames_in_any_unit(unit):
    images = (on_sky_e(3e3) * unit).astype(np.float32)
    found = measure_noise(images, ALL_GOOD, neighbour_prediction(ALL_GOOD, 4.2), NoiseModel(1.0, 81.0))
    assert found.excess_noise_factor == pytest.approx(unit, abs=5 * found.excess_noise_error)
    assert found.floor_e2 == pytest.approx(81.0 * unit**2, abs=5 * found.floor_error_e2)
    assert found.excess_noise_error < 0.1 * unit and found.floor_error_e2 < 5 * unit**2


def test_image_motion_that_fills_a_small_window_is_not_taken_for_noise():
    """A slope that is within its error of 1, however large that is; begun too high, it would stay at 13."""
    window = slice(20, 44)
    images, good = on_sky_e(1e6)[:, window, window], np.ones((24, 24), bool)
    found = measure_noise(images, good, neighbour_prediction(good, 4.2), NoiseModel(1.0, 81.0))
    assert found.excess_noise_factor == pytest.approx(1.0, abs=5 * found.excess_noise_error)
    assert found.excess_noise_error > 0.1
