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


def test_the_encircled_energy_of_an_airy_pattern_is_rayleighs():
    inner = slice(156, -156)  # what lies farther out changes nothing
    found = encircled_energy(airy((2.25, 1.5))[inner, inner], (CENTRE - 156 + 2.25, CENTRE - 156 + 1.5))
    v = np.pi * found.at / RESOLUTION_PX
    np.testing.assert_allclose(found.value, 1 - j0(v) ** 2 - j1(v) ** 2, atol=0.006)
    assert np.interp(1.22 * RESOLUTION_PX, *found) == pytest.approx(0.838, abs=0.004)


def test_white_noise_has_a_flat_spectrum_whatever_is_masked():
    """Mean of 200 draws; its standard error is below a hundredth in every ring."""
    noise = np.random.default_rng(1).standard_normal((200, 32, 48))
    noise[:, 5:9, 7] = np.nan
    mean = np.mean([power_spectrum(one, 4.0).value for one in noise], axis=0)
    np.testing.assert_allclose(mean, 1.0, atol=0.12)
    assert mean.mean() == pytest.approx(1.0, abs=0.01)


def test_correlations_are_those_of_the_draws():
    covariance = np.array([[4.0, 3.0, 0.0], [3.0, 9.0, 0.0], [0.0, 0.0, 0.0]])
    found = correlations(covariance)
    drawn = np.random.default_rng(0).multivariate_normal([0, 0], covariance[:2, :2], 100_000)
    assert found[0, 1] == pytest.approx(np.corrcoef(drawn.T)[0, 1], abs=0.01)
    assert np.isnan(found[2]).all()
