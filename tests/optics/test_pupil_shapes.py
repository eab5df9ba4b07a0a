"""Images of pupils of other shapes.

Truth: HCIPy (independent code), the Fourier transform of polygons (analysis), areas (analysis).
"""

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from helpers.optics_cases import ncpa_nm, settings, vector
from helpers.reference_psf import ReferenceImager, hcipy

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, Vane, placed, turned
from irlos_pipe.conventions.pupil_parts import AmplitudeMap, Circle, Hexagons, Placement, Polygon, Samples
from irlos_pipe.optics.grids import Optics, PupilGrid
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.pupil import (
    amplitudes_of,
    area_weighted_pupil,
    band_limited,
    grid_centres,
    pupil_edges,
    segments_of,
)

pytestmark = pytest.mark.slow
MAS_RAD = np.deg2rad(1 / 3.6e6)
NODES = 6  # per pixel and axis


def hexagon(flat_to_flat_m: float, centre_m: Sequence[float]) -> np.ndarray:
    """Corners of a hexagon with a side at the top, (6, 2) [m]."""
    angles = np.deg2rad(np.arange(6) * 60.0)
    return centre_m + flat_to_flat_m / np.sqrt(3) * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def area_m2(corners_m: np.ndarray) -> float:
    x, y = corners_m.T
    return abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))) / 2


def polygon_image(polygons_m, wavelength_nm: float, window: int, pixel_scale_mas: float, opd_nm=None):
    """Pixel-integrated image, as a fraction of the light through all polygons; one OPD [nm] each."""
    pixel = pixel_scale_mas * MAS_RAD / (wavelength_nm * 1e-9)
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    f = (((np.arange(window) - (window - 1) / 2)[:, None] + nodes / 2) * pixel).ravel()
    phases = np.exp(2j * np.pi * np.broadcast_to(opd_nm or 0.0, len(polygons_m)) / wavelength_nm)
    field = sum(
        phase * _transform(p, f[None, :], f[:, None]) for p, phase in zip(polygons_m, phases, strict=True)
    )
    fine = (np.abs(field) ** 2).reshape(window, NODES, window, NODES)
    total = np.einsum("yjxi,j,i->yx", fine, weights / 2, weights / 2) * pixel**2
    return total / sum(area_m2(p) for p in polygons_m)


def _transform(corners_m: np.ndarray, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
    """``∫ exp(-2πi f·u) du`` over a polygon, by the divergence theorem."""
    found = np.zeros(np.broadcast_shapes(fx.shape, fy.shape), dtype=complex)
    for start, end in zip(corners_m, np.roll(corners_m, -1, axis=0), strict=True):
        (dx, dy), (x, y) = end - start, (start + end) / 2
        found += (fx * dy - fy * dx) * np.sinc(fx * dx + fy * dy) * np.exp(-2j * np.pi * (fx * x + fy * y))
    return found * 1j / (2 * np.pi * (fx**2 + fy**2))


NOLLS = tuple(range(2, 30))
WAVEFRONT = ncpa_nm(3, 29)
FLAT_M, GAP_M = 1.2, 0.05
SEGMENTED = PupilGeometry(6.5, aperture=(Hexagons(FLAT_M, GAP_M, 2, (0,)),))
KECK_LIKE = PupilGeometry(10.95, aperture=(Hexagons(1.5588, 0.003, 3, (0,)),))
VANES = tuple(
    Vane((0.0, 0.0), (4.2 * np.cos(a), 4.2 * np.sin(a)), 0.06) for a in np.deg2rad([90.0, 210.0, 330.0])
)
THREE_VANES = PupilGeometry(8.0, 1.6, VANES)
TURN_DEG = 10.0
L_CORNERS = ((-2.0, -2.0), (2.0, -2.0), (2.0, 0.0), (0.0, 0.0), (0.0, 2.0), (-2.0, 2.0))
ASIDE = Placement.of(17.0, "x", (0.31, -0.17))


def segmented_aperture(grid):
    """Turned, so that no edge lies along the rows of points by which HCIPy's cells are averaged."""
    turn = np.deg2rad(TURN_DEG)
    segment = hcipy.make_hexagonal_aperture(2 / np.sqrt(3) * FLAT_M, np.pi / 2 + turn)
    positions = hcipy.make_hexagonal_grid(FLAT_M + GAP_M, 2)
    outer = positions.as_("polar").r > 0.1
    x, y = positions.x[outer], positions.y[outer]
    turned_xy = [x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)]
    return sum(hcipy.make_shifted_aperture(segment, centre)(grid) for centre in np.transpose(turned_xy))


def three_vane_aperture(grid):
    clear = hcipy.make_obstructed_circular_aperture(8.0, 1.6 / 8.0)(grid)
    for angle in (90, 210, 330):
        clear = clear * hcipy.make_spider_infinite([0, 0], angle + TURN_DEG, 0.06)(grid)
    return clear


def image_of(geometry, wavefront_nm, wavelength_nm=1600.0) -> np.ndarray:
    case = settings(64, ((wavelength_nm, 1.0),), {}, geometry=geometry)
    return PsfModel(case, NOLLS, dtype=torch.float64).images(vector(wavefront_nm, NOLLS))[0].numpy()


def disagreement(image: np.ndarray, truth: np.ndarray) -> float:
    return float(np.abs(image - truth).max() / truth.max())


@pytest.mark.parametrize(
    ("geometry", "aperture", "wavelength_nm"),
    [(SEGMENTED, segmented_aperture, 1250.0), (THREE_VANES, three_vane_aperture, 2150.0)],
    ids=["hexagons", "three vanes"],
)
def test_images_agree_with_hcipy_to_1e_4_of_the_peak(geometry, aperture, wavelength_nm):
    imager, here = ReferenceImager(1024, aperture, geometry.diameter_m), turned(geometry, TURN_DEG)
    for wavefront_nm in ({}, WAVEFRONT):
        truth = imager.image(wavefront_nm, wavelength_nm, (64, 64), 9.7)
        assert disagreement(image_of(here, wavefront_nm, wavelength_nm), truth) <= 1e-4


@pytest.mark.parametrize("flip", ["none", "x", "y"])
def test_a_map_gives_the_image_of_its_samples(flip):
    samples, step_m = 160, 8.4 / 160
    u = grid_centres(samples, step_m)
    drawn = area_weighted_pupil(turned(THREE_VANES, 20.0), u) * np.exp(
        -((u[:, None] - 1) ** 2 + (u - 2) ** 2) / 40
    )  # of no symmetry
    part = AmplitudeMap(Samples.of(drawn), step_m)
    geometry = placed(PupilGeometry(8.0, aperture=(part,)), Placement.of(90.0, flip, (0.0, 0.0)))
    seen = {"none": drawn, "x": drawn[:, ::-1], "y": drawn[::-1]}[flip]
    imager = ReferenceImager(samples, lambda grid: hcipy.Field(np.zeros(grid.size), grid), 8.0, 8.4)
    imager.transmission = np.rot90(seen, -1).ravel()  # rows count upwards, so this is anticlockwise
    imager.area_m2 = float((imager.transmission**2).sum()) * imager.step_m**2
    truth = imager.image(WAVEFRONT, 1600.0, (64, 64), 9.7)
    assert disagreement(image_of(geometry, WAVEFRONT), truth) <= 1e-4


@pytest.mark.parametrize(
    ("part", "area"),
    [
        (Circle(3.0), np.pi * 9 / 4),
        (Polygon(L_CORNERS), 12.0),
        (Hexagons(1.0, 0.1, 1, (0, 3)), 5 * np.sqrt(3) / 2),
    ],
    ids=["circle", "polygon", "hexagons"],
)
def test_parts_have_their_area_as_apertures_and_as_obstructions(part, area):
    u, whole = grid_centres(1600, 0.005), np.pi * 8.0**2 / 4
    lit = area_weighted_pupil(placed(PupilGeometry(8.0, aperture=(part,)), ASIDE), u).sum() * 0.005**2
    dark = area_weighted_pupil(PupilGeometry(8.0, obstructions=(part.placed(ASIDE),)), u).sum() * 0.005**2
    assert lit == pytest.approx(area, rel=1e-4)
    assert whole - dark == pytest.approx(area, rel=1e-4)


def test_pistons_of_segments_agree_with_analysis():
    segments = KECK_LIKE.aperture[0]
    polygons = [hexagon(segments.flat_to_flat_m, centre) for centre in segments.centres_m[1:]]
    pistons_nm = np.random.default_rng(2).normal(0, 100, 36)
    truth = polygon_image(polygons, 1645.0, 64, 9.942, list(pistons_nm))
    case = settings(64, ((1645.0, 1.0),), {}, geometry=KECK_LIKE, pixel_scale_mas=9.942)
    model = PsfModel(case, (4,), dtype=torch.float64)
    grid = PupilGrid.of(KECK_LIKE, case.pupil_samples, [1645e-9])
    phases = np.exp(2j * np.pi * pistons_nm / 1645.0)
    field = (
        np.tensordot(phases, amplitudes_of(segments_of(KECK_LIKE), KECK_LIKE, case.pupil_samples), 1)
        * grid.lit
        * grid.light
    )
    image = model.images(vector({}, (4,)), Optics(torch.as_tensor(field)[None]))[0].numpy()
    assert disagreement(image, truth) <= 3e-5


@pytest.mark.parametrize(
    "geometry",
    [SEGMENTED, PupilGeometry(8.0, 1.1, VANES, obstructions=(Circle(0.7).placed(ASIDE),))],
    ids=["hexagons", "a spot"],
)
def test_derivatives_of_a_displaced_stop_are_those_of_the_drawing(geometry):
    """Truth: differences over several cells of a drawing four times finer."""
    stop, towards, step, fine = np.array([0.08, 0.05]), np.array([0.6, 0.8]), 0.01, 64
    edges = pupil_edges(geometry, 64, 16, tuple(stop))

    def moved(by_m):
        return band_limited(geometry, 64, stop_m=tuple(stop + by_m * towards), subsamples=fine)

    def turned_by(angle):
        return band_limited(turned(geometry, np.rad2deg(angle)), 64, stop_m=tuple(stop), subsamples=fine)

    for found, path in ((edges.moved(tuple(towards)), moved), (edges.turned(), turned_by)):
        truth = (path(step / 4) - path(-step / 4)) / (step / 2)
        assert np.linalg.norm(found - truth) < 0.05 * np.linalg.norm(truth)
