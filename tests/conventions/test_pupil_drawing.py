"""The drawing of the pupil: placements, contents of maps, contradictions."""

import numpy as np
import pytest

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, placed
from irlos_pipe.conventions.pupil_parts import Placement

POINTS = (np.array([0.3, -1.2, 2.0]), np.array([0.7, 0.1, -0.4]))


def test_a_placement_mirrors_then_turns_then_moves():
    assert Placement.of(0.0, "x", (0.0, 0.0)).forth(1.0, 2.0) == pytest.approx((-1, 2))
    assert Placement.of(0.0, "y", (0.0, 0.0)).forth(1.0, 2.0) == pytest.approx((1, -2))
    assert Placement.of(90.0, "none", (3.0, 0.0)).forth(1.0, 0.0) == pytest.approx((3, 1))
    assert Placement.of(90.0, "x", (0.0, 5.0)).forth(1.0, 0.0) == pytest.approx((0, 4))


@pytest.mark.parametrize("first", ["none", "x", "y"])
@pytest.mark.parametrize("second", ["none", "x", "y"])
def test_placements_follow_each_other_and_lead_back(first, second):
    inner, outer = Placement.of(25.0, first, (0.2, -0.4)), Placement.of(-70.0, second, (1.0, 0.3))
    both = inner.then(outer)
    assert np.allclose(both.forth(*POINTS), outer.forth(*inner.forth(*POINTS)))
    assert np.allclose(both.back(*both.forth(*POINTS)), POINTS)


def test_a_moved_disc_takes_its_hole_with_it():
    moved = placed(PupilGeometry(8.0, 1.0), Placement(shift_m=(0.01, 0.0)))
    assert moved.obscuration_m == 0
    assert [part.placement.shift_m for part in (*moved.aperture, *moved.obstructions)] == [(0.01, 0.0)] * 2
