"""The detector of the simulator.

Truth: moments of the Poisson and gamma distributions and of rounding (analysis), sums over many
frames (Monte Carlo), and convolutions written out by hand. The photon-transfer curve is measured
by regressing variance on mean, as an observer does.
"""

from dataclasses import replace

import numpy as np
import pytest
from helpers.simulated_scenes import FACILITY

from irlos_pipe.simulate import SceneError
from irlos_pipe.simulate.detector import DetectorModel, Pattern
from irlos_pipe.simulate.light import Band
from irlos_pipe.simulate.readout import Readout, electrons
from irlos_pipe.simulate.scene import Scene

WINDOW = (40, 48)
BENIGN = Scene("test", FACILITY, (Band(1600.0, 20.0),), (0,), 1, 0.1, window=WINDOW)


def scene(effects: dict | None = None, **detector) -> Scene:
    return replace(BENIGN, effects=effects or {}, detector=DetectorModel(**detector))


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def raw_adu(this: Scene, mean_e: np.ndarray, seed: int = 0) -> np.ndarray:
    """Raw frames of a stack of mean images, float64 [ADU]."""
    readout = Readout.of(this, mean_e.mean(axis=0))
    return readout.frames_adu(mean_e, rng(seed)).astype(float)


def level(value_e: float, frames: int = 1) -> np.ndarray:
    """Evenly lit frames [e-]."""
    return np.full((frames, *WINDOW), float(value_e))


def ramp_of_light(frames: int, top_e: float) -> np.ndarray:
    """Frames of which each column is brighter than the one before [e-]."""
    return np.broadcast_to(np.linspace(0, top_e, WINDOW[1]), (frames, *WINDOW)).copy()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("excess", "read_noise_e", "e_per_adu"), [(1.0, 1.0, 0.5), (1.25, 3.0, 2.0), (1.47, 1.0, 0.15)]
)
def test_photon_transfer_is_excess_noise_times_mean_plus_read_noise(excess, read_noise_e, e_per_adu):
    model = scene(excess_noise_factor=excess, read_noise_e=read_noise_e, e_per_adu=e_per_adu)
    signal_e = (raw_adu(model, ramp_of_light(3000, 400.0)) - 200) * e_per_adu
    mean, variance = signal_e.mean(axis=0).mean(axis=0), signal_e.var(axis=0, ddof=1).mean(axis=0)
    # Each column has 120 000 values: 0.4 % of its variance. Weighted by that error.
    slope, floor = np.polyfit(mean, variance, 1, w=1 / variance)
    assert slope == pytest.approx(excess, rel=0.01)
    expected = excess * mean + read_noise_e**2
    assert variance == pytest.approx(expected, rel=0.02) and np.mean(variance / expected) == pytest.approx(
        1, abs=3e-3
    )
    assert floor == pytest.approx(read_noise_e**2, rel=0.02)


def test_the_read_noise_includes_the_rounding_to_whole_adu():
    for e_per_adu in (0.1, 1.0, 1.5):
        signal_e = (raw_adu(scene(e_per_adu=e_per_adu), level(0, 400)) - 200) * e_per_adu
        assert signal_e.var() == pytest.approx(1.0, rel=0.01)


def test_excess_noise_keeps_the_mean_and_never_makes_negative_light():
    model = scene(excess_noise_factor=1.47, read_noise_e=0.0)
    signal_e = electrons(model, level(2.0, 500), rng())
    assert signal_e.mean() == pytest.approx(2.0, rel=0.005) and signal_e.min() >= 0
    # gamma-distributed gains: third central moment of the sum of a Poisson number N of gains g is N E[g³]
    skew = ((signal_e - signal_e.mean()) ** 3).mean()
    assert skew == pytest.approx(2.0 * 1.47 * (2 * 1.47 - 1), rel=0.05)


def test_crosstalk_shares_charge_with_the_four_neighbours_and_loses_none():
    mean_e = np.zeros((1, *WINDOW))
    mean_e[0, 10, 20] = 1e8
    for model in (scene(crosstalk_fraction=0.08), scene({"interpixel_crosstalk": {"fraction": 0.08}})):
        image = electrons(model, mean_e, rng())[0] / 1e8
        assert image[10, 20] == pytest.approx(0.92, abs=1e-3)
        shares = [image[9, 20], image[11, 20], image[10, 19], image[10, 21]]
        assert shares == pytest.approx([0.02] * 4, abs=1e-4)
        assert image.sum() == pytest.approx(1.0, abs=1e-3)


def test_diffusing_charge_leaves_the_noise_white_and_induced_signal_correlates_it():
    diffused, induced = (
        electrons(scene(**{key: 0.2}), level(1000.0, 400), rng()) - 1000.0
        for key in ("crosstalk_fraction", "coupling_fraction")
    )
    assert diffused.var() == pytest.approx(1001, rel=0.01)
    assert _neighbours(diffused) == pytest.approx(0, abs=5)
    # variance (0.8² + 4·0.05²)·1000 + 1, covariance of neighbours 2·0.8·0.05·1000
    assert induced[:, 1:-1, 1:-1].var() == pytest.approx(651, rel=0.01)
    assert _neighbours(induced) == pytest.approx(80, rel=0.05)


def _neighbours(noise: np.ndarray) -> float:
    """Covariance of horizontal neighbours."""
    inner = noise[:, 1:-1, 1:-1]
    return float((inner[:, :, 1:] * inner[:, :, :-1]).mean())


def test_nonlinearity_takes_its_fraction_at_the_peak_of_the_mean_image():
    mean_e, effect = ramp_of_light(500, 1e5), {"detector_nonlinearity": {"fraction_at_peak": 0.05}}
    measured = electrons(scene(effect), mean_e, rng()).mean(axis=(0, 1))
    linear = mean_e[0, 0]
    assert measured == pytest.approx(linear * (1 - 0.05 * linear / 1e5), rel=1e-3, abs=0.1)


def test_the_dark_shows_pedestal_pattern_dark_current_and_hot_pixels():
    model = scene(fixed_pattern_adu=10.0, dark_e_per_s=50.0, hot_e_per_s=(((3, 4), 5e4),))
    readout = Readout.of(model, level(0)[0])
    expected = readout.pedestal_adu + 5.0 / 0.5
    expected[3, 4] += 5e3 / 0.5
    scatter = (readout.dark_adu(rng()) - expected) * np.sqrt(64)
    assert np.std(readout.pedestal_adu) == pytest.approx(10, rel=0.05)
    assert scatter[3, 4] == pytest.approx(0, abs=5 * np.sqrt(5005) / 0.5)
    scatter[3, 4] = 0
    assert np.std(scatter) == pytest.approx(np.sqrt(5.0 + 1.0) / 0.5, rel=0.05)
    assert scatter.mean() == pytest.approx(0, abs=0.5)


def test_the_flat_undoes_the_response():
    model = scene(flat_rms=0.03, dead=((5, 6),))
    mean_e = level(2e4, 1000)
    readout = Readout.of(model, mean_e[0])
    flat = readout.flat(rng(1))
    image = (readout.frames_adu(mean_e, rng()).mean(axis=0) - 200) * 0.5
    lit = readout.dead() == 0
    assert flat[5, 6] == 0 and readout.dead().sum() == 1 and image[5, 6] == pytest.approx(0, abs=1)
    assert np.std(flat[lit]) == pytest.approx(0.03, rel=0.05)
    assert (image[lit] / flat[lit]) == pytest.approx(2e4, rel=1.3e-3)  # 5.8 times its error
    assert Readout.of(scene(), mean_e[0]).flat(rng()) is None


def test_an_error_of_the_flat_stays_in_the_frames_and_is_seen_in_no_flat():
    """Scatter of 10⁶ e- per pixel from photons: 0.1 %; of 1920 pixels the RMS is known to 1.6 %."""
    model, mean_e = scene(flat_rms=0.03, flat_error_rms=0.02), level(2e4, 50)
    plain, readout = (Readout.of(one, mean_e[0]) for one in (scene(flat_rms=0.03), model))
    assert np.array_equal(plain.flat(rng(1)), readout.flat(rng(1)))
    flattened = electrons(model, mean_e, rng()).mean(axis=0)
    assert np.std(flattened / 2e4) == pytest.approx(0.02, rel=0.06)
    assert Readout.of(scene(flat_error_rms=0.02), mean_e[0]).flat(rng()) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "mean", "variance"), [("hot", 1700, 1701), ("dead", 0, 1), ("stuck", 700, 0)]
)
def test_late_bad_pixels_are_in_the_frames_and_not_in_the_calibration(kind, mean, variance):
    effect = {"bad_pixels": {"pixels": [[2, 3], [7, 9]], "kind": kind, "level_e": 700.0}}
    light = level(1000.0, 4000)
    readout = Readout.of(scene(effect), light[0])
    frames_e = (readout.frames_adu(light, rng()).astype(float) - 200) * 0.5
    for pixel in ((2, 3), (7, 9)):
        values = frames_e[(slice(None), *pixel)]
        assert values.mean() == pytest.approx(mean, rel=0.01, abs=0.1)
        assert values.var() == pytest.approx(variance, rel=0.1)
    assert frames_e[:, 2, 4].mean() == pytest.approx(1000, rel=0.01)
    assert readout.dark_adu(rng()).max() < 205 and readout.dead().sum() == 0


@pytest.mark.slow
def test_a_background_gradient_adds_a_plane_without_photon_noise():
    effect = {"background_gradient": {"e_per_pixel": 2.0, "angle_deg": 90.0, "level_e": 100.0}}
    frames = electrons(scene(effect), level(0, 3000), rng())
    assert frames.mean(axis=0)[:, 5] == pytest.approx(100 + 2 * (np.arange(40) - 19.5), abs=0.1)
    assert frames.var(axis=0).mean() == pytest.approx(1.0, rel=0.01)
    readout = Readout.of(scene(effect), level(0)[0])
    assert readout.dark_adu(rng()).mean() == pytest.approx(200, abs=0.1)


READS = 8


def summed(effects: dict | None = None, *, sky_e_per_s: float = 0.0, **detector) -> Scene:
    """A scene whose frames of 0.04 s are sums of reads."""
    model = DetectorModel(**{"read_s": 0.04 / READS, "e_per_adu": 0.5} | detector)
    return replace(BENIGN, exposure_s=0.04, effects=effects or {}, detector=model, sky_e_per_s=sky_e_per_s)


@pytest.mark.slow
def test_a_frame_has_the_light_of_all_its_reads_and_the_read_noise_of_each():
    for value_e in (0.0, 200.0):
        readout = Readout.of(summed(excess_noise_factor=1.25), level(value_e, 1)[0])
        raw = readout.frames_adu(level(value_e, 300), np.random.default_rng(1))
        assert raw.dtype == np.int32
        signal_e = (raw - READS * readout.pedestal_adu) * 0.5
        assert signal_e.mean() == pytest.approx(value_e, abs=0.05)  # 576 000 values of ≤ 16 e-
        assert signal_e.var() == pytest.approx(1.25 * value_e + READS * 1.0, rel=0.01)


def test_reads_that_do_not_fill_the_exposure_are_refused_in_one_line():
    with pytest.raises(SceneError, match=r"do not add up to exposure_s = 0\.04") as error:
        summed(read_s=0.007)
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
