"""Defocus of high aperture. Truth: the Debye integral by quadrature, and the expansion for small s."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.special import j0

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.optics.defocus import defocus_nm_per_um, defocus_series, shaped_modes
from irlos_pipe.optics.focus_table import FocusTable, Reach
from irlos_pipe.optics.light_path import AS_BUILT
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings

SINE, WAVELENGTH_NM, PIXEL_NM = 0.85, 520.0, 130.0
DIAMETER_M = 2 * SINE  # one metre in front of the focus: 1 nm there is 1e-9 rad
PIXEL_MAS = np.rad2deg(PIXEL_NM * 1e-9) * 3.6e6


def settings(window: int, sine: float = SINE, defocus_nm: float = 0.0) -> PsfSettings:
    known = KnownWavefront(introduced_nm={4: defocus_nm})
    return PsfSettings(
        PupilGeometry(DIAMETER_M, 0.0, ()),
        (window, window),
        PIXEL_MAS,
        ((WAVELENGTH_NM, 1.0),),
        known,
        focus_sine=sine,
    )


def debye_row(z_nm: float, window: int, sine: float = SINE) -> np.ndarray:
    """Middle row of the pixel-integrated image of a point at the distance `z_nm` from the focus."""
    x, w = np.polynomial.legendre.leggauss(400)
    rho, weight = (x + 1) / 2, w / 2 * (x + 1) / 2
    k = 2 * np.pi / WAVELENGTH_NM
    field = weight * np.exp(-1j * k * z_nm * np.sqrt(1 - sine**2 * rho**2))
    inner, share = np.polynomial.legendre.leggauss(6)
    across = (np.arange(window)[:, None] - (window - 1) / 2 + inner / 2) * PIXEL_NM
    radius = np.hypot(across[:, :, None], inner / 2 * PIXEL_NM)
    intensity = np.abs(j0(k * sine * radius[..., None] * rho) @ field) ** 2
    return np.einsum("pij,i,j->p", intensity, share / 2, share / 2)


@pytest.mark.parametrize("z_nm", [0.0, 900.0, -2100.0])
def test_images_agree_with_the_debye_integral(z_nm):
    defocus_nm = z_nm * 1e-3 * defocus_nm_per_um(SINE)
    model = PsfModel(settings(41, defocus_nm=defocus_nm), (4,), dtype=torch.float64)
    row = model.images(torch.zeros(1, 1))[0, 20].numpy()
    truth = debye_row(z_nm, 41)
    truth *= row.sum() / truth.sum()
    assert row == pytest.approx(truth, abs=3e-4 * truth.max())


def test_a_parabola_is_far_from_the_debye_integral():
    defocus_nm = 2.1 * defocus_nm_per_um(SINE)
    model = PsfModel(settings(41, sine=0.0, defocus_nm=defocus_nm), (4,), dtype=torch.float64)
    row, truth = model.images(torch.zeros(1, 1))[0, 20].numpy(), debye_row(2100.0, 41)
    assert np.abs(row / row.sum() - truth / truth.sum()).max() > 0.1 * truth.max() / truth.sum()


def test_the_series_is_the_shape_of_the_path():
    grid = PsfModel(settings(21), (4,)).pupil_grid
    rho = np.hypot(*grid.xy)
    inside = grid.lit & (rho < 1)
    shape = shaped_modes(grid, [4], SINE)[0][inside] * defocus_nm_per_um(SINE)
    path = 1e3 * (1 - np.sqrt(1 - SINE**2 * rho[inside] ** 2))
    assert np.ptp(shape - path) < 2e-3 * np.ptp(path)


def test_small_apertures_have_the_parabola_of_noll_4():
    sine = 0.01
    assert defocus_nm_per_um(sine) == pytest.approx(1e3 * sine**2 / (4 * np.sqrt(3)), rel=1e-4)
    assert defocus_series(sine) == {4: 1.0}
    assert defocus_series(0.0) == {4: 1.0}


def test_the_first_companion_follows_the_expansion():
    sine = 0.1  # s²ρ²/2 + s⁴ρ⁴/8: Noll 4 has (s²/2 + s⁴/8) / (2√3), Noll 11 s⁴ / (48√5)
    expected = sine**4 / (48 * np.sqrt(5)) / ((sine**2 / 2 + sine**4 / 8) / (2 * np.sqrt(3)))
    assert defocus_series(sine)[11] == pytest.approx(expected, rel=0.01)  # the next term is 3s²/4 of it


@pytest.mark.parametrize("sine", [-0.1, 0.99, float("nan")])
def test_an_impossible_sine_is_refused(sine):
    with pytest.raises(ValueError, match="sine of the marginal ray"):
        defocus_series(sine)


def test_derivatives_and_the_table_have_the_same_shape():
    model = PsfModel(settings(31), (2, 3, 4), dtype=torch.float64)
    at = torch.tensor([[5.0, -8.0, 150.0]], dtype=torch.float64)
    image, jacobian = model.images_and_jacobian(at)
    step = torch.tensor([[0.0, 0.0, 1e-3]], dtype=torch.float64)
    numeric = (model.images(at + step) - model.images(at - step)) / 2e-3
    assert jacobian[0, 2].numpy() == pytest.approx(numeric[0].numpy(), abs=1e-6 * float(numeric.abs().max()))
    table = FocusTable(model, AS_BUILT, Reach((-300.0, 300.0), 50.0))
    assert table.images(at).numpy() == pytest.approx(image.numpy(), abs=2e-4 * float(image.max()))
