"""Rotation of Zernike coefficients. Truth: the wavefront evaluated at rotated points, no interpolation."""

import numpy as np
import pytest

from irlos_pipe.optics.zernike import noll_to_nm, partner, rotation_matrix, zernike_basis

NOLLS = tuple(range(2, 67))  # complete radial orders 1 to 10


@pytest.fixture(scope="module")
def disc() -> tuple[np.ndarray, np.ndarray]:
    """Radii and azimuths of random points."""
    rng = np.random.default_rng(1)
    return np.sqrt(rng.uniform(0, 1, 400)), rng.uniform(0, 2 * np.pi, 400)


@pytest.mark.parametrize("angle_deg", [23.0, -71.0, 161.0, 540.0])
def test_coefficients_turn_as_the_wavefront_does(disc, angle_deg):
    radius, azimuth = disc
    coefficients = np.random.default_rng(2).normal(size=len(NOLLS))
    turned = rotation_matrix(NOLLS, angle_deg) @ coefficients
    before = azimuth - np.radians(angle_deg)  # anticlockwise: what was at θ − α is now at θ
    expected = coefficients @ zernike_basis(NOLLS, radius * np.cos(before), radius * np.sin(before))
    found = turned @ zernike_basis(NOLLS, radius * np.cos(azimuth), radius * np.sin(azimuth))
    assert np.abs(found - expected).max() < 1e-11


def test_a_quarter_turn_moves_a_slope_along_x_to_one_along_y():
    assert rotation_matrix((2, 3), 90.0) @ [1.0, 0.0] == pytest.approx([0.0, 1.0])


def test_rotations_keep_the_rms_and_undo_one_another():
    matrix = rotation_matrix(NOLLS, 37.0)
    assert np.allclose(matrix.T @ matrix, np.eye(len(NOLLS)), atol=1e-12)
    assert np.allclose(rotation_matrix(NOLLS, -37.0) @ matrix, np.eye(len(NOLLS)), atol=1e-12)


def test_symmetric_modes_do_not_change():
    symmetric = [row for row, noll in enumerate(NOLLS) if noll_to_nm(noll)[1] == 0]
    matrix = rotation_matrix(NOLLS, 77.0)
    assert np.array_equal(matrix[symmetric], np.eye(len(NOLLS))[symmetric])


def test_every_mode_is_the_partner_of_its_partner():
    assert all(partner(partner(noll)) == noll for noll in range(1, 200))
    assert [partner(noll) for noll in (1, 2, 4, 5, 7, 11)] == [1, 3, 4, 6, 8, 11]


def test_half_a_pair_cannot_be_turned():
    with pytest.raises(ValueError, match="Noll 5 turns into 6"):
        rotation_matrix((4, 5), 10.0)
