"""Light of the sky in a pixel. Truth: magnitudes by hand."""

from dataclasses import replace

import pytest
from helpers.simulated_scenes import FACILITY

SKY = replace(FACILITY, sky_mag_per_arcsec2=((1215.0, 16.5), (1625.0, 14.4)))


def test_a_square_arcsecond_of_magnitude_m_shines_like_such_a_star():
    per_s = SKY.sky_photons_per_s([(1600.0, 1.0)], 1e10, 1000.0)
    assert per_s == pytest.approx(1e10 * 10 ** (-0.4 * 14.4))


def test_bands_add_by_their_weights_and_pixels_by_their_area():
    both = SKY.sky_photons_per_s([(1215.0, 2.0), (1625.0, 2.0)], 1.5e11, 9.7)
    expected = 1.5e11 * 0.0097**2 * (10 ** (-0.4 * 16.5) + 10 ** (-0.4 * 14.4)) / 2
    assert both == pytest.approx(expected)
    assert both == pytest.approx(14, abs=1)  # J and H at Paranal in full-pupil pixels of IRLOS
