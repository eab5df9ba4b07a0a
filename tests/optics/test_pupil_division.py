"""Petals and segments. Truth: the drawing itself, by symmetry and by counting."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.optics_cases import UT4

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane, placed, turned
from irlos_pipe.conventions.pupil_parts import AmplitudeMap, Hexagons, Placement, Samples
from irlos_pipe.optics.pupil import (
    amplitudes_of,
    area_weighted_pupil,
    band_limited_pupil,
    grid_centres,
    petals_of,
    segments_of,
)
from irlos_pipe.simulate import aperture as simulated

SEGMENTS = Hexagons(1.2, 0.05, 2, (0, 5))


def with_vanes(count: int, first_deg: float, reach_m: float = 4.2, **more) -> PupilGeometry:
    """A disc of 8 m with vanes outwards from the axis."""
    angles = np.deg2rad(first_deg + np.arange(count) * 360 / count)
    ends = [(reach_m * np.cos(a), reach_m * np.sin(a)) for a in angles]
    return PupilGeometry(8.0, 1.2, tuple(Vane((0.0, 0.0), end, 0.03) for end in ends), **more)


def at(angle_deg: float, radius_m: float = 2.5) -> tuple[np.ndarray, np.ndarray]:
    angle = np.deg2rad(angle_deg)
    return np.array(radius_m * np.cos(angle)), np.array(radius_m * np.sin(angle))


CASES = [
    (UT4, [45, 135, 225, 315]),
    (with_vanes(3, 90), [30, 150, 270]),
    (with_vanes(3, 30), [90, 210, 330]),
    (with_vanes(6, 0), [30, 90, 150, 210, 270, 330]),
    (with_vanes(4, 0, reach_m=3.95), [45, 135, 225, 315]),  # ends 5 cm before the rim
    (with_vanes(6, 0, aperture=(Hexagons(1.2, 0.02, 2),)), [30, 90, 150, 210, 270, 330]),
]


@pytest.mark.parametrize(("geometry", "angles_deg"), CASES)
def test_petals_are_counted_anticlockwise_from_the_one_nearest_to_the_diagonal(geometry, angles_deg):
    assert petals_of(geometry).count == simulated.petal_count(geometry) == len(angles_deg)
    points = np.array([at(angle) for angle in angles_deg]).T
    assert petals_of(geometry).index(*points).tolist() == list(range(len(angles_deg)))
    assert simulated.petal_index(geometry, *points).tolist() == list(range(len(angles_deg)))


def test_a_map_has_the_petals_that_its_vanes_part():
    u = grid_centres(200, 0.042)
    drawn = area_weighted_pupil(with_vanes(3, 90), u)
    drawn[np.abs(drawn) < 0.6] = 0
    thick = replace(with_vanes(3, 90), vanes=tuple(replace(v, width_m=0.15) for v in with_vanes(3, 90).vanes))
    lit = PupilGeometry(8.4, aperture=(AmplitudeMap(Samples.of(area_weighted_pupil(thick, u)), 0.042),))
    assert petals_of(lit).count == simulated.petal_count(lit) == 3
    assert petals_of(lit).index(*np.array([at(a) for a in (30, 150, 270)]).T).tolist() == [0, 1, 2]


def test_vanes_wider_than_a_cell_or_not_part_petals_whose_light_adds_up():
    for width_m in (0.002, 0.3):
        vanes = tuple(replace(vane, width_m=width_m) for vane in UT4.vanes)
        geometry = replace(UT4, vanes=vanes)
        parts = amplitudes_of(petals_of(geometry), geometry, 64)
        assert parts.shape[0] == 4
        assert np.allclose(parts.sum(0), band_limited_pupil(geometry, 64)[1], atol=1e-12)
        right, top, left, bottom = parts.sum((1, 2))
        assert (right, top) == pytest.approx((left, bottom), rel=0.01)


@pytest.mark.parametrize("angle_deg", [0.0, 37.0])
def test_segments_are_those_drawn_and_their_light_adds_up(angle_deg):
    geometry = turned(PupilGeometry(6.5, 1.0, aperture=(SEGMENTS,)), angle_deg)
    parts = amplitudes_of(segments_of(geometry), geometry, 64)
    assert segments_of(geometry).count == len(parts) == 17
    assert np.allclose(parts.sum(0), band_limited_pupil(geometry, 64)[1], atol=1e-12)
    whole = np.sqrt(3) / 2 * 1.2**2 / (6.5 / 64) ** 2
    assert parts[6:].sum((1, 2)) == pytest.approx(np.full(11, whole), rel=1e-3)


def test_numbers_of_segments_turn_and_flip_with_the_pupil():
    geometry, placement = PupilGeometry(7.0, aperture=(SEGMENTS,)), Placement.of(20.0, "x", (0.1, 0.05))
    xy = np.array([piece.placement.shift_m for piece in geometry.segments]).T
    assert segments_of(geometry).index(*xy).tolist() == list(range(17))
    carried = placed(geometry, placement)
    assert segments_of(carried).index(*placement.forth(*xy)).tolist() == list(range(17))
    assert simulated.segment_index(carried, *placement.forth(*xy)).tolist() == list(range(17))
