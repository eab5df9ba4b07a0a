"""OTF cuts, encircled energy, power spectra; truth: the Airy pattern, Parseval's theorem, Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import j0, j1

from irlos_pipe.optics.image_quality import correlations, encircled_energy, power_spectrum, transfer_cut

RESOLUTION_PX, SIDE = 8.0, 513  # λ/D, finely sampled, in a wide window
CENTRE = (SIDE - 1) / 2


def airy(offset_px: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Light per pixel of an Airy pattern of unit flux, at points."""
    y, x = np.indices((SIDE, SIDE)) - CENTRE
    v = np.pi * np.hypot(y - offset_px[0], x - offset_px[1]) / RESOLUTION_PX
    v = np.where(v == 0, 1e-9, v)
    return np.pi / 4 / RESOLUTION_PX**2 * (2 * j1(v) / v) ** 2


@pytest.mark.parametrize("axis", [0, 1])
def test_the_otf_of_a_clear_circle_is_the_overlap_of_two_circles(axis):
    found = transfer_cut(airy((3.0, -2.0)), RESOLUTION_PX, axis)
    inside = found.at < 1
    nu = found.at[inside]
    true = 2 / np.pi * (np.arccos(nu) - nu * np.sqrt(1 - nu**2))
    assert found.value[0] == pytest.approx(1)
    np.testing.assert_allclose(found.value[inside], true, atol=0.012)  # 0.8 % of the light lies outside
    assert np.abs(found.value[~inside & (found.at > 1.02)]).max() < 0.002


def test_a_wider_pixel_multiplies_the_otf_by_its_sinc():
    image, wide = airy(), 5
    summed = sum(np.roll(image, shift, axis=1) for shift in range(-(wide // 2), wide // 2 + 1))
    plain, pixel = (transfer_cut(one, RESOLUTION_PX, 1) for one in (image, summed))
    seen = plain.at < 0.9
    frequency_px = plain.at[seen] / RESOLUTION_PX
    dirichlet = np.sinc(wide * frequency_px) / np.sinc(frequency_px)  # five points for a pixel
    np.testing.assert_allclose(pixel.value[seen], plain.value[seen] * dirichlet, atol=1e-3)


def test_the_encircled_energy_of_an_airy_pattern_is_rayleighs():
    inner = slice(156, -156)  # what lies farther out changes nothing
    found = encircled_energy(airy((2.25, 1.5))[inner, inner], (CENTRE - 156 + 2.25, CENTRE - 156 + 1.5))
    v = np.pi * found.at / RESOLUTION_PX
    np.testing.assert_allclose(found.value, 1 - j0(v) ** 2 - j1(v) ** 2, atol=0.006)
    assert np.interp(1.22 * RESOLUTION_PX, *found) == pytest.approx(0.838, abs=0.004)


def test_a_circle_around_even_light_holds_its_area():
    found = encircled_energy(np.ones((41, 41)), (20.0, 20.0))
    np.testing.assert_allclose(found.value[4:], np.pi * found.at[4:] ** 2, rtol=0.02)


def test_white_noise_has_a_flat_spectrum_whatever_is_masked():
    """Mean of 200 draws; its standard error is below a hundredth in every ring."""
    noise = np.random.default_rng(1).standard_normal((200, 32, 48))
    noise[:, 5:9, 7] = np.nan
    mean = np.mean([power_spectrum(one, 4.0).value for one in noise], axis=0)
    np.testing.assert_allclose(mean, 1.0, atol=0.12)
    assert mean.mean() == pytest.approx(1.0, abs=0.01)


def test_a_ripple_stands_at_its_own_frequency_and_power_is_kept():
    x = np.arange(64)
    ripple = np.broadcast_to(np.sqrt(2) * np.cos(2 * np.pi * 8 * x / 64), (64, 64))
    found = power_spectrum(ripple, 4.0)
    assert found.at[np.argmax(found.value)] == pytest.approx(8 / 64 * 4.0, rel=0.03)
    rings = np.rint(np.hypot(*np.meshgrid(np.fft.fftfreq(64), np.fft.fftfreq(64))) * 64)
    assert found.value[7] * np.sum(rings == 8) == pytest.approx((ripple**2).sum())  # Parseval


def test_an_image_without_light_has_no_otf():
    assert np.isnan(transfer_cut(np.zeros((8, 8)), 4.0, 1).value).all()


def test_correlations_are_those_of_the_draws():
    covariance = np.array([[4.0, 3.0, 0.0], [3.0, 9.0, 0.0], [0.0, 0.0, 0.0]])
    found = correlations(covariance)
    drawn = np.random.default_rng(0).multivariate_normal([0, 0], covariance[:2, :2], 100_000)
    assert found[0, 1] == pytest.approx(np.corrcoef(drawn.T)[0, 1], abs=0.01)
    assert np.isnan(found[2]).all()
