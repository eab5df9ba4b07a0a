"""Zernike polynomials. Truth: the table of Noll (1976), numerical integration, HCIPy."""

from __future__ import annotations

import numpy as np
import pytest

from irlos_pipe.optics.zernike import noll_to_nm, rotation_matrix, zernike, zernike_basis

# Noll 1976, table I: index -> (n, m), with the sign that his even-is-cosine rule gives
NOLL_TABLE = {
    1: (0, 0), 2: (1, 1), 3: (1, -1), 4: (2, 0), 5: (2, -2), 6: (2, 2), 7: (3, -1), 8: (3, 1), 9: (3, -3),
    10: (3, 3), 11: (4, 0), 12: (4, 2), 13: (4, -2), 14: (4, 4), 15: (4, -4), 16: (5, 1), 17: (5, -1),
    22: (6, 0), 37: (8, 0),
}  # fmt: skip


def disc(radii: int = 40, angles: int = 64):
    """Points and weights that integrate polynomials over the unit disc exactly."""
    nodes, weights = np.polynomial.legendre.leggauss(radii)
    squared = (nodes + 1) / 2  # uniform in r²
    theta = np.arange(angles) * 2 * np.pi / angles
    x = np.outer(np.sqrt(squared), np.cos(theta)).ravel()
    y = np.outer(np.sqrt(squared), np.sin(theta)).ravel()
    return x, y, np.repeat(weights / 2 / angles, angles)


@pytest.mark.parametrize(("noll", "orders"), NOLL_TABLE.items(), ids=str)
def test_indices_follow_the_table_of_noll(noll, orders):
    assert noll_to_nm(noll) == orders


@pytest.mark.parametrize("noll", [0, -3])
def test_an_index_below_one_is_refused(noll):
    with pytest.raises(ValueError, match="start at 1"):
        noll_to_nm(noll)


def test_modes_are_orthonormal_over_the_unobscured_disc():
    x, y, weight = disc()
    modes = zernike_basis(range(1, 67), x, y)
    assert (modes * weight) @ modes.T == pytest.approx(np.eye(66), abs=1e-10)


@pytest.mark.slow
def test_all_modes_are_those_of_hcipy():
    hcipy = pytest.importorskip("hcipy")
    grid = hcipy.make_pupil_grid(32, 2.0)
    x, y = np.asarray(grid.x), np.asarray(grid.y)
    for noll in range(1, 67):
        theirs = hcipy.zernike(*hcipy.noll_to_zernike(noll), D=2.0, grid=grid, radial_cutoff=False)
        assert zernike(noll, x, y) == pytest.approx(np.asarray(theirs), abs=1e-9)


NOLLS = tuple(range(2, 67))  # complete radial orders 1 to 10


@pytest.mark.parametrize("angle_deg", [23.0, -71.0, 161.0, 540.0])
def test_coefficients_turn_as_the_wavefront_does(angle_deg):
    """Truth: the wavefront evaluated at rotated points, no interpolation."""
    rng = np.random.default_rng(1)
    radius, azimuth = np.sqrt(rng.uniform(0, 1, 400)), rng.uniform(0, 2 * np.pi, 400)
    coefficients = rng.normal(size=len(NOLLS))
    turned = rotation_matrix(NOLLS, angle_deg) @ coefficients
    before = azimuth - np.radians(angle_deg)  # anticlockwise: what was at θ − α is now at θ
    expected = coefficients @ zernike_basis(NOLLS, radius * np.cos(before), radius * np.sin(before))
    found = turned @ zernike_basis(NOLLS, radius * np.cos(azimuth), radius * np.sin(azimuth))
    assert np.abs(found - expected).max() < 1e-11


def test_half_a_pair_cannot_be_turned():
    with pytest.raises(ValueError, match="Noll 5 turns into 6"):
        rotation_matrix((4, 5), 10.0)
