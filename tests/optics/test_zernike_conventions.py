"""Zernike coefficients of other conventions against HCIPy and published polynomials."""

import hcipy
import numpy as np
import pytest

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.optics.zernike import noll_nm, zernike_basis

R, T = (one.ravel() for one in np.meshgrid(np.linspace(0.01, 1, 60), np.linspace(0, 2 * np.pi, 73)))
HOLE = 0.35
# Polynomials without a factor by their Fringe index (Shannon, Art and Science of Optical Design, 1997).
FRINGE = {
    2: R * np.cos(T), 3: R * np.sin(T), 4: 2 * R**2 - 1, 5: R**2 * np.cos(2 * T), 6: R**2 * np.sin(2 * T),
    7: (3 * R**3 - 2 * R) * np.cos(T), 8: (3 * R**3 - 2 * R) * np.sin(T), 9: 6 * R**4 - 6 * R**2 + 1,
    10: R**3 * np.cos(3 * T), 11: R**3 * np.sin(3 * T), 12: (4 * R**4 - 3 * R**2) * np.cos(2 * T),
    13: (4 * R**4 - 3 * R**2) * np.sin(2 * T), 15: (10 * R**5 - 12 * R**3 + 3 * R) * np.sin(T),
    16: 20 * R**6 - 30 * R**4 + 12 * R**2 - 1, 17: R**4 * np.cos(4 * T),
    25: 70 * R**8 - 140 * R**6 + 90 * R**4 - 20 * R**2 + 1, 27: R**5 * np.sin(5 * T),
}  # fmt: skip
# On the annulus, of unit RMS there, by Noll index (V. N. Mahajan, JOSA 71, 75, 1981, table I).
E2 = HOLE**2
COMA = (3 * (1 + E2) * R**3 - 2 * (1 + E2 + E2**2) * R) / (
    (1 - E2) * np.sqrt((1 + E2) * (1 + 4 * E2 + E2**2))
)
ANNULAR = {
    3: 2 * R * np.sin(T) / np.sqrt(1 + E2), 4: np.sqrt(3) * (2 * R**2 - 1 - E2) / (1 - E2),
    6: np.sqrt(6) * R**2 * np.cos(2 * T) / np.sqrt(1 + E2 + E2**2), 8: np.sqrt(8) * COMA * np.cos(T),
    11: np.sqrt(5) * (6 * R**4 - 6 * (1 + E2) * R**2 + 1 + 4 * E2 + E2**2) / (1 - E2) ** 2,
}  # fmt: skip


def opd_nm(zernike_nm: dict[int, float]) -> np.ndarray:
    """The wavefront without its mean, for piston is left out."""
    values = np.array(list(zernike_nm.values())) @ zernike_basis(
        list(zernike_nm), R * np.cos(T), R * np.sin(T)
    )
    return values - values.mean()


@pytest.mark.parametrize(
    ("order", "modes"), [("osa", hcipy.ansi_to_zernike), ("noll", hcipy.noll_to_zernike)]
)
def test_osa_and_noll_coefficients_make_the_wavefront_of_hcipy(order, modes):
    grid = hcipy.PolarGrid(hcipy.UnstructuredCoords([R, T]))
    values = np.random.default_rng(2).normal(size=44)
    first = 0 if order == "osa" else 1
    basis = [hcipy.zernike(*modes(index + first), D=2, grid=grid, radial_cutoff=False) for index in range(44)]
    expected = 1e3 * values @ np.array(basis)
    np.testing.assert_allclose(
        opd_nm(noll_nm(values, order, unit="um")), expected - expected.mean(), atol=1e-8
    )


@pytest.mark.parametrize("index", FRINGE)
def test_fringe_coefficients_make_the_published_polynomials_in_peak_and_in_peak_to_valley(index):
    expected = 633 * 0.25 * FRINGE[index]
    found = opd_nm(noll_nm({index: 0.25}, "fringe", unit="waves", wavelength_nm=633))
    np.testing.assert_allclose(found, expected - expected.mean(), atol=1e-8)
    valley = opd_nm(noll_nm({index: np.pi}, "fringe", unit="rad", size="pv", wavelength_nm=633))
    assert np.ptp(valley) == pytest.approx(633 / 2, rel=4e-3)  # on a grid, which misses the extremes


@pytest.mark.parametrize("noll", ANNULAR)
def test_annular_coefficients_make_the_published_polynomials_of_the_annulus(noll):
    found = opd_nm(noll_nm({noll: 100.0}, obscuration=HOLE))
    np.testing.assert_allclose(found, 100 * (ANNULAR[noll] - ANNULAR[noll].mean()), atol=1e-8)


@pytest.mark.parametrize(
    ("coefficients", "convention", "message"),
    [
        ({4: 1}, {"order": "OSA"}, "unknown 'OSA'; known: noll, osa, ansi, fringe"),
        ({-1: 1}, {"order": "osa"}, "-1 is no index of order 'osa': 0, …"),
        ({1001: 1}, {}, "1001 is no index of order 'noll'.* Noll 1000"),
        ({4: np.nan}, {}, "noll 4: nan is no number"),
        ([0, 1, "x"], {"order": "osa"}, "osa 2: 'x' is no number"),
        ({4: 1}, {"unit": "waves"}, "coefficients in waves need wavelength_nm"),
        ({4: 1}, {"obscuration": 0.3, "size": "pv"}, "below 1, with size 'rms'"),
    ],
)
def test_what_no_convention_has_and_what_says_too_little_is_refused(coefficients, convention, message):
    with pytest.raises(ConfigurationError, match=message):
        noll_nm(coefficients, **convention)
