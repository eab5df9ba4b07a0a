"""The transform from pupil to focal plane in real arithmetic.

Truth: the complex Fourier sum of the same samples, written out with NumPy (analysis).
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.light_path_derivatives import assert_jacobian, assert_pullback
from numpy.polynomial import chebyshev

from irlos_pipe.conventions.pupil_drawing import PupilGeometry, with_sizes
from irlos_pipe.effects import CATALOGUE, EffectSet
from irlos_pipe.effects.motion import TipTiltJitter
from irlos_pipe.effects.redrawn_pupil import PupilSizes
from irlos_pipe.effects.wavefront import HighOrderNcpa
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.focus_table import ShiftMatrices
from irlos_pipe.optics.fourier_matrices import FocalGrid, MatrixDft, mirrored, products_up_to
from irlos_pipe.optics.lenslets import LensletArray
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.optics.pupil import grid_centres
from irlos_pipe.simulate.aperture import passed

STEP_M, FRAMES = 0.25, 2


def fields(samples: int) -> np.ndarray:
    real, imag = np.random.default_rng(samples).standard_normal((2, FRAMES, samples, samples))
    return real + 1j * imag


def as_real(field: np.ndarray) -> torch.Tensor:
    return mirrored(torch.as_tensor(np.stack([field.real, field.imag], axis=1)))


def as_complex(amplitude: torch.Tensor) -> np.ndarray:
    return torch.complex(*amplitude.unbind(-3)).numpy()


class Case:
    """A transform, and the complex matrix of the same grids."""

    def __init__(self, samples: int, focal: int, degree: int):
        self.u_m = grid_centres(samples, STEP_M)
        grid = FocalGrid(focal, samples * STEP_M, 2 * focal, samples * STEP_M)
        self.polynomials = chebyshev.chebvander(self.u_m / self.u_m[-1], degree).T
        self.dft = MatrixDft(self.u_m, grid, self.polynomials, torch.zeros((), dtype=torch.float64))
        self.matrix = np.exp(-2j * np.pi * np.outer(grid.frequency_per_m, self.u_m)) * STEP_M


@pytest.fixture(params=[(24, 12, 5), (14, 20, 4), (16, 9, 0)], ids=str)
def case(request) -> Case:
    return Case(*request.param)


def test_the_amplitude_is_the_fourier_sum(case):
    field = fields(len(case.u_m))
    truth = case.matrix @ field @ case.matrix.T
    ours = as_complex(case.dft.amplitude(as_real(field)))
    assert ours == pytest.approx(truth, abs=1e-12 * abs(truth).max())


def test_the_adjoint_is_the_transpose(case):
    """``<A E, V> = <E, Aᵀ V>`` for any field and any amplitude."""
    field = as_real(fields(len(case.u_m)))
    amplitude = case.dft.amplitude(field)
    other = torch.as_tensor(np.random.default_rng(2).standard_normal(amplitude.shape))
    assert (case.dft.adjoint(other) * field).sum().item() == pytest.approx((amplitude * other).sum().item())


def test_products_are_the_fourier_sums_of_the_field_times_polynomials(case):
    field = fields(len(case.u_m))
    found = np.concatenate([as_complex(part) for part in case.dft.products(as_real(field))])
    for (a, b), ours in zip(products_up_to(len(case.polynomials) - 1), found, strict=True):
        weighted = field * case.polynomials[b][:, None] * case.polynomials[a]
        truth = (-1j) ** (a % 2 + b % 2) * (case.matrix @ weighted @ case.matrix.T)
        assert ours == pytest.approx(truth, abs=1e-12 * abs(truth).max()), (a, b)


# Images through 2x2 lenslets. Truth: the Fourier integral written out, and finite differences.


UT4 = load_instrument("irlos").pupil
MAS_RAD = np.pi / 180 / 3600e3
SPECTRUM = ((1250.0, 0.4), (1650.0, 0.6))
NOLLS = (2, 3, 4, 5, 6, 7)
MODES_NM = (40.0, -25.0, 90.0, 30.0, -50.0, 35.0)
SIGNS = ((-1, -1), (-1, 1), (1, -1), (1, 1))  # of y and x: lower left, lower right, upper left, upper right


def settings(scale_mas: float = 78.0, size: int = 18, geometry: PupilGeometry = UT4) -> PsfSettings:
    window, known = (2 * size, 2 * size), KnownWavefront()
    wide = PsfSettings(geometry, window, scale_mas, SPECTRUM, known, lenslets=2)
    return replace(wide, pupil_samples=max(128, wide.needed_samples)).for_broad_images()


def wavefront_nm(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Noll 2 to 7 written out; x and y in radii."""
    r2 = x**2 + y**2
    modes = (
        2 * x,
        2 * y,
        np.sqrt(3) * (2 * r2 - 1),
        2 * np.sqrt(6) * x * y,
        np.sqrt(6) * (x**2 - y**2),
        np.sqrt(8) * (3 * r2 - 2) * y,
    )
    return sum(nm * mode for nm, mode in zip(MODES_NM, modes, strict=True))


def integral(scale_mas: float, size: int, nodes: int) -> np.ndarray:
    """|∫ P exp(2πiΦ/λ) exp(−2πi a·u/λ) du|² over every quarter, integrated over pixels by Gauss's rule."""
    u = (np.arange(500) - 249.5) * 8.1 / 500
    x, y = np.meshgrid(u, u)
    clear = passed(UT4, u[None, :], u[:, None]) * 1.0
    opd_nm = wavefront_nm(x / 4, y / 4)
    inner, weights = np.polynomial.legendre.leggauss(nodes)
    angle = ((np.arange(size) - (size - 1) / 2)[:, None] + inner / 2).ravel() * scale_mas * MAS_RAD
    images = []
    for side_y, side_x in SIGNS:
        image = np.zeros((size, size))
        for wavelength_nm, share in SPECTRUM:
            wave = np.exp(-2j * np.pi * np.outer(angle, u) / (wavelength_nm * 1e-9))
            field = clear * (x * side_x > 0) * (y * side_y > 0) * np.exp(2j * np.pi * opd_nm / wavelength_nm)
            fine = np.abs(wave @ field @ wave.T) ** 2 / (wavelength_nm * 1e-9) ** 2
            boxes = fine.reshape(size, nodes, size, nodes)
            image += share * np.einsum("yjxi,j,i->yx", boxes, weights / 2, weights / 2)
        images.append(image * (u[1] - u[0]) ** 2 * (scale_mas * MAS_RAD) ** 2 / clear.sum())
    return np.block([images[:2], images[2:]])


@pytest.mark.parametrize(("scale_mas", "size", "nodes"), [(78.0, 10, 6), (314.0, 6, 16)])
def test_images_are_the_fourier_integral_over_each_quarter(scale_mas, size, nodes):
    model = LensletArray(settings(scale_mas, size), NOLLS, dtype=torch.float64)
    image = model.images(torch.tensor([MODES_NM], dtype=torch.float64))[0].numpy()
    expected = integral(scale_mas, size, nodes)
    assert np.abs(image - expected).max() < 2e-4 * expected.max()
    assert image.sum() == pytest.approx(expected.sum(), rel=3e-4)


def test_derivatives_are_finite_differences_with_effects_in_all_planes():
    psf = LensletArray(settings(size=12), NOLLS, dtype=torch.float64)
    effects = EffectSet([TipTiltJitter(), HighOrderNcpa((12,)), CATALOGUE["plate_scale"](78.0)], psf.grids)
    values = torch.tensor([25.0, 90.0, 0.02], dtype=torch.float64)
    assert [one.name.startswith("frac") for one in effects.parameters] == [False, False, True]
    assert_jacobian(psf, effects, torch.tensor([MODES_NM]).double(), values, [2.5e-3, 9e-3, 1e-6], 1e-5)


def test_the_pullback_is_the_gradient_of_a_weighted_sum():
    psf = LensletArray(settings(size=10), NOLLS, dtype=torch.float64)
    modes = torch.tensor([MODES_NM, MODES_NM[::-1]], dtype=torch.float64)
    assert_pullback(psf, EffectSet([], psf.grids), modes, torch.zeros(0))


def test_a_pupil_that_an_effect_redraws_is_that_of_its_drawing():
    """A wider central hole and wider vanes, as an effect and as the geometry of another array."""
    told = settings(size=10)
    effect = PupilSizes(UT4)
    drawn = replace(told, geometry=with_sizes(UT4, obscuration_m=1.3, vane_width_m=0.06))
    psf, modes = LensletArray(told, NOLLS, dtype=torch.float64), torch.tensor([MODES_NM], dtype=torch.float64)
    values = torch.tensor(effect.values_of(obscuration_m=1.3, vane_width_m=0.06), dtype=torch.float64)
    by_effect = psf.images(modes, EffectSet([effect], psf.grids)(values))
    by_drawing = LensletArray(drawn, NOLLS, dtype=torch.float64).images(modes)
    by_drawing *= by_effect.sum() / by_drawing.sum()  # its light counts as that of its own pupil
    assert (by_effect - by_drawing).abs().max() < 2e-4 * by_drawing.max()


def test_an_odd_window_has_no_lenslets():
    with pytest.raises(ValueError, match="15x12 px has no four equal quarters"):
        LensletArray(replace(settings(), window=(15, 12)), NOLLS)


# Band-limited shifts. Truth: functions known in closed form whose spectrum ends where it is said to.


BAND, BEYOND = 0.32, 16
LIKE = torch.empty(0, dtype=torch.float64)


def profile(x: np.ndarray) -> np.ndarray:
    """``sinc⁴``, whose spectrum is a convolution of four boxes and ends at `BAND` exactly."""
    return np.sinc(BAND / 2 * x) ** 4


def slope(x: np.ndarray) -> np.ndarray:
    """Its derivative, by central differences in steps far below a pixel."""
    return (profile(x + 1e-5) - profile(x - 1e-5)) / 2e-5


def along(pixels: int, centre: float) -> np.ndarray:
    """Distances of the pixels of a window from `centre`, which counts from the window's middle."""
    return np.arange(pixels) - (pixels - 1) / 2 - centre


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.45), (-3.7, 5.2), (6.9, -6.9)])
@pytest.mark.parametrize("window", [(24, 24), (20, 33)])
def test_an_image_and_its_slopes_are_moved_to_where_they_belong(window, shift):
    rows, columns = window
    wide = np.outer(profile(along(rows + 2 * BEYOND, 0.4)), profile(along(columns + 2 * BEYOND, -1.3)))
    matrices = ShiftMatrices(window, BEYOND, BAND, 1.0, LIKE)
    along_y, along_x = (m[0].numpy() for m in matrices(torch.tensor([shift], dtype=torch.float64)))
    moved = along_y @ wide[::-1, ::-1] @ along_x.T
    y, x = along(rows, 0.4 + shift[1]), along(columns, -1.3 + shift[0])
    truth = np.outer(profile(y), profile(x))
    assert np.abs(moved[:rows, :columns] - truth).max() < 1e-5
    assert np.abs(moved[rows:, :columns] + np.outer(slope(y), profile(x))).max() < 1e-5
    assert np.abs(moved[:rows, columns:] + np.outer(profile(y), slope(x))).max() < 1e-5
