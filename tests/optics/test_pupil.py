"""The sampled pupil. Truth: areas and Fourier transforms by analysis, and the aperture of HCIPy."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.optics_cases import UT4
from helpers.reference_psf import reference
from scipy.special import j1

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane, placed, turned
from irlos_pipe.conventions.pupil_parts import AmplitudeMap, Circle, Hexagons, Placement, Samples
from irlos_pipe.optics.image_quality import ring_means
from irlos_pipe.optics.pupil import (
    CLEAN_BAND,
    amplitudes_of,
    area_weighted_pupil,
    band_limited,
    band_limited_pupil,
    grid_centres,
    petals_of,
    segments_of,
)
from irlos_pipe.optics.wavefront import clear_disc, modes_at, opd_maps_nm, opd_sigma_nm
from irlos_pipe.optics.zernike import noll_to_nm, rotation_matrix, zernike, zernike_basis
from irlos_pipe.simulate import aperture as simulated

RING = PupilGeometry(8.0, 1.116)


def sampled(geometry: PupilGeometry, samples: int = 256) -> tuple[np.ndarray, np.ndarray, float]:
    step = geometry.diameter_m / samples
    centres = grid_centres(samples, step)
    return centres, area_weighted_pupil(geometry, centres), step


def test_the_ut4_pupil_is_that_of_an_independent_library():
    theirs, ours = (binned(pupil) for pupil in (reference().transmission, sampled(UT4, 1024)[1]))
    assert ours.sum() == pytest.approx(theirs.sum(), rel=1e-5)
    # they count 32 x 32 points in a cell: an edge along a row of points moves 1/32 of it
    assert np.abs(ours - theirs).max() < 1 / 32


def binned(pupil: np.ndarray) -> np.ndarray:
    """Means over 8 x 8 cells of a grid of 1024 x 1024."""
    return pupil.reshape(128, 8, 128, 8).mean((1, 3))


def spectrum(u: np.ndarray, amplitude: np.ndarray, frequency_per_m: np.ndarray) -> np.ndarray:
    """Fourier sum along the diagonal and both axes of the frequency plane."""
    waves = np.exp(-2j * np.pi * np.outer(frequency_per_m, u))
    return (waves @ amplitude @ waves.T) * (u[1] - u[0]) ** 2


def test_the_band_limited_pupil_has_the_spectrum_of_the_sharp_edge():
    u, amplitude = band_limited_pupil(RING, 96)
    reach = CLEAN_BAND / (2 * (u[1] - u[0]))
    f = np.linspace(-reach, reach, 41)
    radius = np.hypot(f[:, None], f[None])

    def disc(diameter):
        z = np.maximum(np.pi * diameter * radius, 1e-12)
        return np.pi * diameter**2 / 2 * j1(z) / z

    exact = np.where(radius <= reach, disc(8.0) - disc(1.116), 0)
    ours = np.where(radius <= reach, spectrum(u, amplitude, f), 0)
    assert np.abs(ours - exact).max() < 1e-5 * exact.max()


@pytest.mark.parametrize("stop_m", [(0.0, 0.0), (0.11, -0.07)], ids=["on axis", "displaced"])
@pytest.mark.parametrize("geometry", [UT4, RING, PupilGeometry(8.0)], ids=["vanes", "ring", "disc"])
def test_cells_away_from_the_edges_are_all_clear_or_all_dark(geometry, stop_m):
    """Truth: every fine cell drawn by itself, as where an obstruction is drawn; this one covers nothing."""
    nowhere = Circle(1e-6).placed(Placement.of(0.0, "none", (3.99, 3.99)))
    every = replace(geometry, obstructions=(nowhere,))
    assert geometry.plain and not every.plain
    ours, theirs = (band_limited(one, 48, stop_m=stop_m, subsamples=8) for one in (geometry, every))
    assert ours == pytest.approx(theirs, abs=1e-12)


# Petals and segments. Truth: the drawing itself, by symmetry and by counting.


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


# Zernike polynomials. Truth: HCIPy, and the wavefront at rotated points.


@pytest.mark.parametrize("noll", [0, -3])
def test_an_index_below_one_is_refused(noll):
    with pytest.raises(ValueError, match="start at 1"):
        noll_to_nm(noll)


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


# Maps of wavefronts and azimuthal means. Truth: closed forms of low modes and of simple images.


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


def test_the_error_of_a_map_is_the_scatter_of_maps_of_that_covariance():
    root, lit = np.array([[3.0, 0.0, 0.0], [2.0, 1.0, 0.0], [-1.0, 0.5, 2.0]]), clear_disc(UT4, 20)
    draws = opd_maps_nm((4, 6, 11), np.random.default_rng(1).normal(size=(4000, 3)) @ root.T, lit)
    found = opd_sigma_nm((4, 6, 11), root @ root.T, lit)
    assert found[lit] == pytest.approx(draws.std(axis=0)[lit], rel=0.06)  # 5 standard errors
    assert np.isnan(found[~lit]).all()
