"""Statistics of the simulated AO residual.

Truth: the seeing law and von Kármán's spectrum as written here, periodograms of many screens, and for
the aliased spectrum a Shack–Hartmann sensor sampled numerically.
"""

import numpy as np
import pytest
from helpers.simulated_scenes import FACILITY, scene

from irlos_pipe.simulate.atmosphere import ResidualScreens, Sky, aliasing_psd, von_karman_nm2_m2
from irlos_pipe.simulate.camera import pupil_of
from irlos_pipe.simulate.scene import Sampling

COARSE = 64  # samples across the pupil, for statistics that need many screens
FAR_APART_S = 0.5  # longer than any lifetime of a stationary residual


def screens(sky: Sky, count: int, step_s: float = FAR_APART_S, samples: int = COARSE, seed: int = 5):
    """Telescope and `count` successive screens of its pupil, (count, n, n) float64 [nm]."""
    pupil = pupil_of(scene(sampling=Sampling(pupil_samples=samples)))
    series = ResidualScreens(sky, FACILITY, pupil, np.random.default_rng(seed))
    stack = np.array([series.next_nm(step_s) for _ in range(count)], float)
    return pupil.telescope, pupil.inside(stack)


def pupil_variance(telescope, stack: np.ndarray) -> np.ndarray:
    """Mean square over the pupil of each screen."""
    weight = telescope.transmission / telescope.transmission.sum()
    return np.sum(weight * stack**2, axis=(1, 2))


def periodogram(telescope, stack: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies fx (1, n), fy (n, 1) [1/m] and mean spectrum [nm² m²] under a Hann window."""
    n, step_m = stack.shape[-1], telescope.step_m
    taper = np.outer(*[np.hanning(n + 2)[1:-1]] * 2)
    power = np.mean(np.abs(np.fft.fft2(stack * taper)) ** 2, axis=0) * step_m**2 / np.sum(taper**2)
    f = np.fft.fftfreq(n, step_m)
    return f[None, :], f[:, None], power


def fitted_slope(fx, fy, power, low: float, high: float) -> float:
    f = np.broadcast_to(np.hypot(fx, fy), power.shape)
    ring = (f >= low) & (f < high)
    return float(np.polyfit(np.log(f[ring]), np.log(power[ring]), 1)[0])


@pytest.mark.parametrize("seeing_arcsec", [0.35, 1.0])
@pytest.mark.parametrize("shape", ["power_law", "servo_lag", "aliasing"])
def test_the_residual_follows_the_seeing_law(seeing_arcsec, shape):
    telescope, stack = screens(Sky(seeing_arcsec, shape=shape), 500)
    found_nm = np.sqrt(pupil_variance(telescope, stack).mean())
    assert np.isclose(found_nm, 104.27 * seeing_arcsec + 58.6, rtol=0.03)


@pytest.mark.slow
def test_a_drifting_residual_follows_the_law_on_average_and_bursts():
    sky = Sky(0.8, shape="non_stationary")
    telescope, stack = screens(sky, 2000, step_s=3 * sky.drift_s, samples=32)
    variance = pupil_variance(telescope, stack)
    assert np.isclose(np.sqrt(variance.mean()), 104.27 * 0.8 + 58.6, rtol=0.03)
    _, steady = screens(Sky(0.8), 2000, samples=32)
    own = pupil_variance(telescope, steady).var() / steady.var() ** 2
    # Squares of a log-normal size of relative RMS r scatter by (1 + r²)^4 - 1.
    drifted = variance.var() / variance.mean() ** 2
    assert np.isclose(drifted, (1 + own) * (1 + sky.drift_rms**2) ** 4 - 1, rtol=0.25)


@pytest.mark.slow
def test_an_uneven_residual_has_the_variance_asked_for_in_every_place():
    """Truth: the same with a residual that is everywhere alike, times the variance asked for."""
    parts = {4: 0.35, 2: -0.15}
    telescope, stack = screens(Sky(0.8, variance_zernike=parts), 1500)
    even = screens(Sky(0.8), 1500)[1]
    expected = 1 + sum(part * telescope.mode(noll) for noll, part in parts.items())
    y_m, x_m = np.meshgrid(telescope.u_m, telescope.u_m, indexing="ij")
    for place in (np.hypot(x_m, y_m) < 1.5, x_m < -2.5, x_m > 2.5):
        lit = place & (telescope.transmission > 0.99)
        ratio = (stack**2).mean(0)[lit].mean() / (even**2).mean(0)[lit].mean()
        # Turbulence beyond the cut-off is a tenth of the variance.
        assert np.isclose(ratio, expected[lit].mean(), atol=0.1)
    assert np.isclose(
        pupil_variance(telescope, stack).mean(), pupil_variance(telescope, even).mean(), rtol=0.05
    )


@pytest.mark.slow
@pytest.mark.parametrize("slope", [2.0, 3.0])
def test_the_spectrum_inside_the_band_has_the_given_slope(slope):
    fx, fy, power = periodogram(*screens(Sky(0.8, slope=slope), 400))
    assert np.isclose(fitted_slope(fx, fy, power, 0.6, 2.1), -slope, atol=0.1)


def test_beyond_the_cut_off_the_turbulence_is_uncorrected():
    fx, fy, power = periodogram(*screens(Sky(1.0), 400))
    r0_m = 0.976 * 500e-9 / np.deg2rad(1 / 3600)
    f = np.broadcast_to(np.hypot(fx, fy), power.shape)
    ring = (f > 2.9) & (f < 3.7)
    expected = 0.0229 * r0_m ** (-5 / 3) * f[ring] ** (-11 / 3) * (500 / (2 * np.pi)) ** 2
    assert np.isclose(power[ring].mean(), expected.mean(), rtol=0.05)


def test_servo_lag_stretches_the_spectrum_along_the_wind():
    fx, fy, power = periodogram(*screens(Sky(0.8, shape="servo_lag", wind_angle_deg=30.0), 400))
    f, angle = np.hypot(fx, fy), np.arctan2(fy, fx)
    ring = (f > 0.6) & (f < 2.0)
    weight = power[ring] * f[ring]
    second = np.sum(weight * np.exp(2j * angle[ring])) / weight.sum()
    assert np.isclose(np.rad2deg(np.angle(second)) / 2, 30.0, atol=3.0)
    across = np.abs(np.sin(angle - np.deg2rad(30.0)))
    along_mean, across_mean = (power[ring & part].mean() for part in (across < 0.25, across > 0.97))
    assert 5 < along_mean / across_mean < 15


@pytest.mark.slow
def test_the_aliased_spectrum_is_what_a_shack_hartmann_sensor_folds_back():
    sky, pitch_m = Sky(1.0), 0.2
    f = np.array([0.9, -1.6])
    folded = [np.array([kx, ky]) for kx in range(-3, 4) for ky in range(-3, 4) if (kx, ky) != (0, 0)]
    aliases = [f + k / pitch_m for k in folded]
    seen = [
        abs(_reconstructed(f, g, pitch_m)) ** 2 * von_karman_nm2_m2(np.hypot(*g), sky, FACILITY)
        for g in aliases
    ]
    assert np.isclose(aliasing_psd(f[:1], f[1:], sky, FACILITY)[0], sum(seen), rtol=1e-3)


def _reconstructed(f: np.ndarray, g: np.ndarray, pitch_m: float) -> complex:
    """What a least-squares reconstructor makes, at frequency f, of a wave exp(2πi g·x) of height 1.

    Mean gradients by numerical averages over a sub-aperture, of the wave and of the two gradients that
    a wave at f would give; the two-component system is solved by least squares.
    """
    inner = (np.arange(400) + 0.5) / 400 * pitch_m - pitch_m / 2
    x, y = np.meshgrid(inner, inner)

    def gradients(frequency: np.ndarray) -> np.ndarray:
        wave = np.exp(2j * np.pi * (frequency[0] * x + frequency[1] * y)).mean()
        return 2j * np.pi * frequency * wave

    return np.linalg.lstsq(gradients(f)[:, None], gradients(g), rcond=None)[0][0]


@pytest.mark.slow
def test_the_frozen_flow_carries_the_pattern_along_the_wind():
    sky, step_s = Sky(1.0, wind_m_s=8.0, wind_angle_deg=70.0), 0.010
    telescope, stack = screens(sky, 400, step_s=step_s)
    taper = np.outer(*[np.hanning(COARSE + 2)[1:-1]] * 2)
    spectra = np.fft.fft2(stack * taper)
    cross = np.mean(spectra[1:] * spectra[:-1].conj(), axis=0)
    f = np.fft.fftfreq(COARSE, telescope.step_m)
    fx, fy = f[None, :], f[:, None]
    ring = (np.hypot(fx, fy) > 2.8) & (np.hypot(fx, fy) < 3.6)
    wind = 8.0 * np.array([np.cos(np.deg2rad(70)), np.sin(np.deg2rad(70))])
    turned = cross * np.exp(2j * np.pi * step_s * (fx * wind[0] + fy * wind[1]))
    assert abs(np.angle(turned[ring].sum())) < 0.05
    boiled = turned[ring].sum().real / np.mean(np.abs(spectra) ** 2, axis=0)[ring].sum()
    assert np.isclose(boiled, np.exp(-step_s / 0.2), atol=0.03)


def test_the_residual_inside_the_band_lives_ten_milliseconds():
    telescope, stack = screens(Sky(0.5, wind_m_s=0.0), 600, step_s=0.010)
    astigmatism = telescope.fit_zernike_nm(stack, 8)[:, 3]
    correlation = np.mean(astigmatism[1:] * astigmatism[:-1]) / astigmatism.var()
    assert np.isclose(correlation, np.exp(-1.0), atol=0.1)
