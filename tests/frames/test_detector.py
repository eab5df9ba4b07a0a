"""Counts to electrons, levels, and the noise measured on a star."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import made_run
from helpers import optics_cases as cases
from helpers.sparta_files import SAMPLING_PX, counts, frames_e, star
from scipy import integrate
from simulator.detector import Detector as SimulatedDetector

from irlos_pipe.frames.bad_pixels import neighbour_prediction
from irlos_pipe.frames.cleaning import (
    find_background,
    relative_flat,
    saturation_level,
    to_electrons,
)
from irlos_pipe.frames.noise import ExposureNoise, NoiseModel
from irlos_pipe.frames.recording import SIDECAR, CalibrationMaps, Detector, star_position
from irlos_pipe.frames.told import (
    LAST_PER_PX,
    MeasuredNoise,
    cutoff_ratio,
    dark_variance_e2,
    measure_noise,
    told_of,
    wrapped_pixels,
)
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.psf import PsfModel

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


# The noise model. Truth: Monte Carlo with the detector of ``data_samples`` (independent code), analysis.


LEVELS_E = np.array([0.0, 3.0, 40.0, 900.0, 20_000.0])


@pytest.mark.parametrize("excess", [1.0, 1.47])
def test_simulated_frames_scatter_as_the_model_says(excess):
    """Read noise counts once, as a variance: F x signal + sigma² within 1 %."""
    simulated = SimulatedDetector(e_per_adu=0.5, read_noise_e=3.0, excess_noise_factor=excess)
    rng = np.random.default_rng(1)
    mean_e = np.repeat(LEVELS_E, 100_000)[None]
    frame = simulated.read_out(mean_e, np.full(mean_e.shape, 500.0), 1.0, rng) * 0.5
    measured = frame.reshape(len(LEVELS_E), -1).var(1)
    noise = NoiseModel.of_detector(Detector(0.5, 3.0, excess))
    assert noise.variance_e2(LEVELS_E) == pytest.approx(measured, rel=0.02)
    assert np.mean(noise.variance_e2(LEVELS_E) / measured) == pytest.approx(1, abs=0.01)


def half_deviance(noise: NoiseModel, seen_e: torch.Tensor, model_e: torch.Tensor) -> torch.Tensor:
    """How much less likely a model is than the data themselves."""
    return noise.minus_quasi_likelihood(seen_e, model_e) - noise.minus_quasi_likelihood(seen_e, seen_e)


@pytest.mark.parametrize("seen_e", [-7.0, 0.0, 3.0, 900.0])
@pytest.mark.parametrize("model_e", [-4.0, 0.0, 5.0, 800.0])
def test_the_deviance_is_the_integral_of_the_slope_of_least_squares(seen_e, model_e):
    noise = NoiseModel(1.4, 5.0, 2.0)
    expected, _ = integrate.quad(
        lambda t: (seen_e - t) / float(noise.variance_e2(np.float64(t))), model_e, seen_e, points=[0.0]
    )
    found = half_deviance(noise, *(torch.tensor([one], dtype=torch.float64) for one in (seen_e, model_e)))
    assert float(found) == pytest.approx(expected, rel=1e-8, abs=1e-9)


def test_without_read_noise_the_deviance_is_that_of_poisson_s_law():
    seen = torch.tensor([3.0, 40.0, 900.0], dtype=torch.float64)
    model = torch.tensor([5.0, 38.0, 1000.0], dtype=torch.float64)
    poisson = seen * (seen / model).log() - (seen - model)
    found = half_deviance(NoiseModel(1.0, 1e-9), seen, model)
    assert found.numpy() == pytest.approx(poisson.numpy(), rel=1e-6)


def test_reads_sky_and_dark_add_up_in_variance():
    noise = ExposureNoise(200, 1.0, 1.25, sky_e=14.0, dark_e=2.0)
    assert noise.floor_e2 == pytest.approx(200 + 1.25 * 16)


# Noise of the dark image, seen in the frames; truth by Monte Carlo with known variances.


ALL_GOOD = np.ones((64, 64), dtype=bool)


def star_e(peak_e: float = 1e4, sampling_px: float = 4.2) -> np.ndarray:
    """An Airy-like image of so many pixels per λ/D with wings, by the Fourier transform of a disc."""
    y, x = np.indices((256, 256)) - 128
    field = np.fft.fftshift(np.fft.fft2(np.hypot(x, y) < 256 / sampling_px / 2))
    image = (abs(field) ** 2)[96:160, 96:160]
    return peak_e * image / image.max()


def frames_e_of_measured_noise(
    dark_sigma_e: float, star: np.ndarray | None = None, count: int = 60, seed: int = 0
) -> np.ndarray:
    rng = np.random.default_rng(seed)
    photons = rng.poisson(star_e() if star is None else star, (count, 64, 64))
    return photons + rng.normal(0, 1.0, photons.shape) - rng.normal(0, dark_sigma_e, (64, 64))


def dark_noise_e2(frames_e: np.ndarray, sampling_px: float = 4.2) -> float:
    return dark_variance_e2(frames_e, ALL_GOOD, neighbour_prediction(ALL_GOOD, sampling_px), np.inf)


@pytest.mark.parametrize("sigma_e", [0.2, 0.5, 2.0])
def test_the_noise_of_the_dark_is_found_in_the_frames(sigma_e):
    """To the error of eight draws, a tenth, and what the star's wings add, less than 0.01 e-²."""
    found = np.mean([dark_noise_e2(frames_e_of_measured_noise(sigma_e, seed=s)) for s in range(8)])
    assert found == pytest.approx(sigma_e**2, rel=0.15, abs=0.01)


@pytest.mark.parametrize("sampling_px", [2.4, 3.0, 4.2])
def test_a_star_as_fine_as_pixels_show_is_not_the_noise_of_a_dark(sampling_px):
    """Of a lamp, below half the noise that photons and reads leave in the mean of the 60 frames."""
    star = star_e(1e6, sampling_px)
    found_e2 = dark_noise_e2(frames_e_of_measured_noise(0.0, star), sampling_px)
    assert found_e2 < 0.5 * np.median(star + 1) / 60


@pytest.mark.parametrize("level_e", [-3.0, 0.0, 3.0])
def test_a_background_that_is_off_by_some_electrons_does_not_change_the_photon_transfer(level_e):
    """Ten frames of a gain as told: a slope of 1 to five of its errors, and less of an error than a tenth."""
    prediction = neighbour_prediction(ALL_GOOD, 4.2)
    images = frames_e_of_measured_noise(0.0, count=10, seed=3) + level_e
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


@pytest.mark.parametrize("unit", [1e-6, 0.03, 1e6])
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


def test_image_motion_that_fills_a_small_window_is_not_taken_for_noise():
    """A slope that is within its error of 1, however large that is; begun too high, it would stay at 13."""
    window = slice(20, 44)
    images, good = on_sky_e(1e6)[:, window, window], np.ones((24, 24), bool)
    found = measure_noise(images, good, neighbour_prediction(good, 4.2), NoiseModel(1.0, 81.0))
    assert found.excess_noise_factor == pytest.approx(1.0, abs=5 * found.excess_noise_error)
    assert found.excess_noise_error > 0.1


# Contradictions between what was told and what frames show, on images drawn from the model.


FACILITY = load_instrument("irlos").facility
CUTOFF_PER_PX = 9.7e-3 / 206264.8 * 8.0 / 1600e-9
ZERO_POINT_E = 150_000 * 10 ** (0.4 * (15 - 7.0)) * 0.1  # of J = 7 in 0.1 s


def _recording(flux_e: float = 0.05 * ZERO_POINT_E, **keys):
    one = made_run.recording("sky", "calibration", 4)
    images = one.images_e * (flux_e / one.images_e[0].sum())
    told = {"mag_j": 7.0, "exposure_s": 0.1, "frame_rate_hz": 10.0} | keys
    acquisition = replace(one.acquisition, **told, sources=dict.fromkeys(told, SIDECAR))
    return replace(one, images_e=images, acquisition=acquisition)


def _found(recording, noise: MeasuredNoise | None = None, step_s: float = 0.1) -> tuple[set[str], set[str]]:
    """Names of what is warned of, and of what is wrong beyond doubt."""
    told = told_of(recording, noise or MeasuredNoise(), FACILITY, step_s)
    return {one.name for one in told if one.warned}, {one.name for one in told if one.wrong}


def test_what_is_told_rightly_is_not_doubted():
    assert _found(_recording()) == (set(), set())


def test_photon_transfer_contradicts_a_gain_four_times_off_but_not_within_its_error():
    recording = replace(
        _recording(), acquisition=replace(_recording().acquisition, detector=Detector(2.0, 1.0))
    )
    assert "photon noise" in _found(recording, MeasuredNoise(1.0, 0.1, 0.01, 0.001))[1]
    assert "photon noise" not in _found(recording, MeasuredNoise(1.0, 0.1, 9.0, 2.0))[1]


@pytest.mark.parametrize(
    "keys", [{"diversity": {6: -0.17}}, {"diversity": {1000: -170.0}}, {"pixel_scale_mas": 0.0097}]
)
def test_implausible_values_are_worth_a_warning(keys):
    assert _found(_recording(**keys))[0]


def test_the_image_ends_at_the_cut_off_of_the_telescope():
    """In the mean of 50 frames of a star with 3e6 photons."""
    image = PsfModel(cases.settings(48), (4,)).images(torch.tensor([[40.0]]))[0].double().numpy()
    mean_e = np.random.default_rng(1).poisson(image * 1.5e8) / 50
    good = np.ones(mean_e.shape, bool)
    assert 0.75 < cutoff_ratio(mean_e, good, CUTOFF_PER_PX) < 1.1
    assert cutoff_ratio(mean_e, good, CUTOFF_PER_PX / 1.5) > 1.25  # scale told too small by a third
    smear = 2 / len(mean_e) / (1.5 * CUTOFF_PER_PX)  # of the taper, half the width of its main lobe
    assert cutoff_ratio(mean_e, good, CUTOFF_PER_PX * 1.5) == pytest.approx(1 / 1.5, abs=smear)
    assert np.isnan(cutoff_ratio(mean_e, good, CUTOFF_PER_PX * 3))  # beyond what the pixels sample
    assert cutoff_ratio(mean_e, good, CUTOFF_PER_PX * 3, LAST_PER_PX) == pytest.approx(1 / 3, abs=smear / 2)
    assert np.isnan(
        cutoff_ratio(mean_e / 1e6 + np.random.default_rng(2).normal(size=mean_e.shape), good, 0.2)
    )


@pytest.mark.parametrize(
    ("peak", "width_px", "bits", "wrapped"), [(9e4, 4.0, 16, True), (3e5, 0.8, 32, False)]
)
def test_counts_have_overflowed_where_they_begin_again_within_16_bits(peak, width_px, bits, wrapped):
    y, x = np.mgrid[-20:21, -20:21]
    adu = (peak * np.exp(-(x**2 + y**2) / 2 / width_px**2)) % 2**bits
    assert bool(wrapped_pixels(np.tile(adu, (3, 1, 1)))) is wrapped
