"""Maps of wavefronts and azimuthal means. Truth: closed forms of low modes and of simple images."""

import numpy as np
import pytest
from helpers.optics_cases import UT4

from irlos_pipe.optics.image_quality import ring_means
from irlos_pipe.optics.wavefront import clear_disc, modes_at, opd_maps_nm

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


def test_ring_means_of_a_cone_are_its_radii_and_leave_bad_pixels_out():
    rows, columns = np.indices((21, 25))
    cone = np.hypot(rows - 10, columns - 12)
    cone[3, 4] = np.nan
    radius, mean = ring_means(cone, (10, 12))
    assert mean == pytest.approx(radius) and len(radius) == 10
    assert len(ring_means(cone, (10, 12), reach_px=4)[0]) == 4
