"""Maps of wavefronts and azimuthal means. Truth: closed forms of low modes and of simple images."""

import numpy as np
import pytest
from helpers.optics_cases import UT4

from irlos_pipe.optics.azimuthal_mean import ring_means
from irlos_pipe.optics.psf_settings import KnownWavefront
from irlos_pipe.optics.wavefront import clear_disc, clear_pupil, modes_at, opd_maps_nm, opd_sigma_nm

SAMPLES = 80


def test_a_map_of_defocus_is_the_written_polynomial_where_there_is_light():
    lit = clear_disc(UT4, SAMPLES)
    centres = (np.arange(SAMPLES) - (SAMPLES - 1) / 2) * 2 / SAMPLES
    radius2 = centres[:, None] ** 2 + centres[None, :] ** 2
    maps = opd_maps_nm((2, 4), np.array([[0.0, 30.0], [10.0, 0.0]]), lit)
    assert maps[0][lit] == pytest.approx(30.0 * np.sqrt(3) * (2 * radius2[lit] - 1))
    assert maps[1][lit] == pytest.approx(20.0 * np.broadcast_to(centres, lit.shape)[lit])
    assert np.isnan(maps[:, ~lit]).all()
    assert maps[0][lit] == pytest.approx(30.0 * modes_at((4,), lit)[0])


def test_the_error_of_a_map_is_the_scatter_of_maps_of_that_covariance():
    root, lit = np.array([[3.0, 0.0, 0.0], [2.0, 1.0, 0.0], [-1.0, 0.5, 2.0]]), clear_disc(UT4, 20)
    draws = opd_maps_nm((4, 6, 11), np.random.default_rng(1).normal(size=(4000, 3)) @ root.T, lit)
    found = opd_sigma_nm((4, 6, 11), root @ root.T, lit)
    assert found[lit] == pytest.approx(draws.std(axis=0)[lit], rel=0.06)  # 5 standard errors
    assert np.isnan(found[~lit]).all()


def test_the_clear_pupil_is_the_disc_without_the_vanes():
    pupil, disc = clear_pupil(UT4, 400), clear_disc(UT4, 400)
    assert not (pupil & ~disc)[np.hypot(*np.indices(disc.shape) - 199.5) < 199].any()
    assert 0.97 < pupil.sum() / disc.sum() < 1.0


def test_the_parts_of_the_known_wavefront_add_up_mode_by_mode():
    known = KnownWavefront({6: -170.0, 4: 5.0}, {4: 200.0}, {6: 30.0, 7: 1.0})
    assert known.total_nm == {6: -140.0, 4: 205.0, 7: 1.0}


def test_ring_means_of_a_cone_are_its_radii_and_leave_bad_pixels_out():
    rows, columns = np.indices((21, 25))
    cone = np.hypot(rows - 10, columns - 12)
    cone[3, 4] = np.nan
    radius, mean = ring_means(cone, (10, 12))
    assert mean == pytest.approx(radius) and len(radius) == 10
    assert len(ring_means(cone, (10, 12), reach_px=4)[0]) == 4
