"""Spectrum from filter and star. Truth: integrals over the curve, and Planck's law by astropy."""

from __future__ import annotations

import numpy as np
import pytest
from astropy import units as u
from astropy.modeling.models import BlackBody

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.readers.acquisition import photons, spectrum_of

J_AND_H = [(1150, 0), (1157, 0.8), (1273, 0.8), (1280, 0), (1530, 0), (1541, 0.9), (1709, 0.9), (1720, 0)]


def test_photons_are_those_of_planck_s_law():
    nm = np.array([1000.0, 1600.0, 2300.0])
    radiance = BlackBody(4000 * u.K, scale=1 * u.W / u.m**2 / u.um / u.sr)(nm * u.nm).value * nm
    assert photons(nm, 4000) / photons(nm, 4000)[0] == pytest.approx(radiance / radiance[0], rel=1e-6)


@pytest.mark.parametrize("kelvin", [3500.0, 9600.0])
def test_three_points_per_band_have_its_photons_and_mean_wavelength(kelvin):
    points = np.array(spectrum_of(J_AND_H, kelvin, "here"))
    fine = np.linspace(1150, 1720, 100_001)
    weight = np.interp(fine, *np.array(J_AND_H, float).T) * photons(fine, kelvin)
    for low, high, own in ((1150, 1280, slice(0, 3)), (1530, 1720, slice(3, 6))):
        band = (fine > low) & (fine < high)
        assert points[own, 1].sum() == pytest.approx(weight[band].sum() / weight.sum(), rel=2e-3)
        mean = np.average(fine[band], weights=weight[band])
        assert np.average(points[own, 0], weights=points[own, 1]) == pytest.approx(mean, abs=0.2)
    assert len(points) == 6 and points[:, 1].sum() == pytest.approx(1)


@pytest.mark.parametrize(
    ("curve", "message"),
    [
        (
            J_AND_H[:-1],
            "does not cover the band: at its longest wavelength, 1709 nm, the filter still transmits 0.9",
        ),
        (J_AND_H[1:], "does not cover the band: at its shortest wavelength, 1157 nm"),
        (J_AND_H[::-1], "wavelengths should rise"),
    ],
)
def test_a_curve_that_is_none_is_refused(curve, message):
    with pytest.raises(InputDataError, match=message):
        spectrum_of(curve, 5000.0, "here")
