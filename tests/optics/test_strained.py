"""Images whose scale differs by direction.

Truth: the Airy pattern at stretched angles (analysis), HCIPy's image of a pupil in stretched coordinates
(independent code), splines of scipy through a finer image without strain, finite differences.
"""

import numpy as np
import pytest
import torch
from helpers.optics_cases import J_AND_H, MAS_RAD, NARROW_H, SCALE_MAS, ncpa_nm, settings, vector
from helpers.reference_psf import ReferenceImager, hcipy, ut4_aperture
from scipy.special import j1

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.effects import EffectSet, FixedEffect, TipTiltJitter
from irlos_pipe.effects.colour import Anamorphism, PlateScale, Spectrum
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.optics.psf import PsfModel

NOLLS = tuple(range(2, 31))
STATIC_NM = ncpa_nm(3, NOLLS[-1], 120.0)
FRACTION, ANGLE_DEG = 0.05, 33.0
NODES = 6  # per pixel and axis


def stretch(fraction: float = FRACTION, angle_deg: float = ANGLE_DEG) -> np.ndarray:
    """Scales along and across with a difference of `fraction` of their mean and a product of one."""
    along = np.sqrt((2 + fraction) / (2 - fraction))
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    turn = np.array([[c, -s], [s, c]])
    return turn @ np.diag([along, 1 / along]) @ turn.T


def held(fraction: float = FRACTION, angle_deg: float = ANGLE_DEG) -> FixedEffect:
    return FixedEffect(Anamorphism(), Anamorphism().values_of(fraction, angle_deg))


def image(case, *effects, zernike_nm=STATIC_NM, **options) -> np.ndarray:
    model = PsfModel(case, NOLLS, **{"dtype": torch.float64} | options)
    return model.images(vector(zernike_nm, NOLLS), EffectSet(effects, model.grids)())[0].double().numpy()


def sky_px(window: tuple[int, int], matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where points inside the pixels lie on the undistorted image, x and y [px], and their weights."""
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    y, x = (((np.arange(n) - (n - 1) / 2)[:, None] + nodes / 2).ravel() for n in window)
    grid = np.stack(np.meshgrid(x, y))
    return *np.tensordot(np.linalg.inv(matrix), grid, 1), weights / 2


def over_pixels(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    rows, columns = (size // NODES for size in values.shape)
    return np.einsum("yjxi,j,i->yx", values.reshape(rows, NODES, columns, NODES), weights, weights)


@pytest.mark.parametrize("angle_deg", [0.0, 33.0, 90.0, 135.0])
def test_the_airy_pattern_is_larger_along_the_angle_and_keeps_its_area(angle_deg):
    window = (31, 36)
    case = settings(window, diversity={}, geometry=PupilGeometry(8.0), margin_mas=600.0)
    found = image(case, held(angle_deg=angle_deg), zernike_nm={})
    x, y, weights = sky_px(window, stretch(angle_deg=angle_deg))
    pixel = SCALE_MAS * MAS_RAD
    z = np.pi * 8.0 / 1.6e-6 * np.hypot(x, y) * pixel
    airy = np.pi * 16.0 * (2 * j1(z) / z) ** 2 / 1.6e-6**2 * pixel**2
    expected = over_pixels(airy, weights)
    assert found == pytest.approx(expected, abs=2e-5 * expected.max())
    plain = image(case, zernike_nm={})
    assert np.abs(plain - expected).max() > 0.01 * expected.max()


class StretchedPupil(ReferenceImager):
    """HCIPy's pupil and Zernikes at points ``M v``: its image at p is that of the pupil itself at M⁻¹ p."""

    def __init__(self, matrix: np.ndarray):
        self._matrix = matrix
        super().__init__(768, lambda grid: ut4_aperture(self._stretched(grid)), width_m=8.6)

    def _stretched(self, grid):
        x, y = self._matrix @ np.stack([np.asarray(grid.x), np.asarray(grid.y)])
        return hcipy.CartesianGrid(hcipy.UnstructuredCoords([x, y]))

    def _mode(self, noll: int) -> np.ndarray:
        n, m = hcipy.noll_to_zernike(noll)
        return np.asarray(hcipy.zernike(n, m, D=8.0, grid=self._stretched(self.grid), radial_cutoff=False))


@pytest.mark.slow
def test_aberrated_images_are_those_of_a_pupil_in_stretched_coordinates():
    case = settings((48, 41), J_AND_H[2:4])
    truth = StretchedPupil(stretch()).spectral_image(STATIC_NM, case)
    assert image(case, held()) == pytest.approx(truth, abs=1e-4 * truth.max())


@pytest.mark.parametrize("others", [(), (FixedEffect(TipTiltJitter(), [64.0]),)], ids=["alone", "in motion"])
def test_the_pullback_is_the_transposed_jacobian(others):
    whole = ImageModel(PsfModel(settings((24, 27)), NOLLS, dtype=torch.float64), [held(), *others])
    at = vector(STATIC_NM, NOLLS), torch.tensor([1e6]).double(), torch.tensor([3.0]).double()
    images, jacobian = whole.predict_and_jacobian(*at)
    same, pullback = whole.predict_and_pullback(*at)
    factors = torch.as_tensor(np.random.default_rng(1).normal(size=images.shape))
    expected = (jacobian * factors[:, None]).sum((2, 3)).numpy()
    assert same.numpy() == pytest.approx(images.numpy(), rel=1e-9)
    assert pullback(factors).numpy() == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("values", [[0.0, 0.0], [0.03, -0.05]], ids=["absent", "strong"])
def test_derivatives_are_finite_differences_with_rough_modes_too(values):
    psf = PsfModel(settings((24, 27)), NOLLS[:8], dtype=torch.float64, rough_derivatives=True)
    whole = ImageModel(psf, [Anamorphism()])
    at = vector(STATIC_NM, psf.nolls), torch.ones(1).double(), torch.zeros(1).double()
    here, modes = torch.tensor(values).double(), torch.eye(8).double() * 0.05
    jacobian = whole.predict_and_jacobian(*at, here)[1][0]
    for index, step in enumerate(torch.eye(2).double() * 1e-4):
        truth = (whole.predict(*at, here + step) - whole.predict(*at, here - step))[0] / 2e-4
        assert jacobian[8 + index].numpy() == pytest.approx(
            truth.numpy(), abs=2e-5 * float(truth.abs().max())
        )
    high, low = (whole.predict(at[0] + s * modes[3], *at[1:], here)[0] for s in (1, -1))
    truth = ((high - low) / 0.1).numpy()
    assert jacobian[3].numpy() == pytest.approx(truth, abs=1e-5 * np.abs(truth).max())


@pytest.mark.parametrize("start", [[0.0, 0.0], [0.03, -0.05]], ids=["absent", "strong"])
def test_automatic_differentiation_sees_strain_scale_and_colour(start):
    psf = PsfModel(settings((24, 27), J_AND_H[::3]), (2, 3, 4), dtype=torch.float64)
    effects = EffectSet([Anamorphism(), PlateScale(SCALE_MAS), Spectrum(1400.0)], psf.grids)
    by_name = {"anamorphism": start, "plate_scale": [0.01], "spectrum": [10.0, 0.1, 0.05]}
    values = torch.tensor([v for one in effects.effects for v in by_name[one.name]]).double()
    whole, modes = ImageModel(psf, effects), torch.tensor([[20.0, -30.0, 60.0]]).double()
    at = modes, torch.ones(1).double(), torch.zeros(1).double()
    weights = torch.as_tensor(np.random.default_rng(2).normal(size=(1, 24, 27)))
    moving = values.clone().requires_grad_()
    (weights * whole.predict(*at, moving)).sum().backward()
    jacobian = whole.predict_and_jacobian(*at, values)[1][:, 3:-2]
    expected = (jacobian * weights[:, None]).sum((0, 2, 3)).numpy()
    assert moving.grad.numpy() == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


def test_a_window_that_strain_takes_beyond_the_computed_field_is_refused():
    case = settings(71, NARROW_H, margin_mas=1.0)
    image(case)
    with pytest.raises(ValueError, match="alias"):
        image(case, held(0.1, 45.0))
