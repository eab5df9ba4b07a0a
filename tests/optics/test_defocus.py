"""Defocus of high aperture. Truth: the Debye integral by quadrature, and the expansion for small s."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.special import j0

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.optics.focus_table import FocusTable, Reach, defocus_nm_per_um, defocus_series
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
