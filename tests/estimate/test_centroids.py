"""Defocus from centroids. Truth: mean slopes by numerical integration, and images of known wavefronts."""

import numpy as np
import pytest
import torch

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.estimate.lenslets import NOLLS, SIDES, gradient_matrix, modes_of_centroids_nm
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.lenslets import LensletArray
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.optics.zernike import zernike_basis

MAS_RAD = np.pi / 180 / 3600e3
UT4 = load_instrument("irlos").pupil


def test_the_gradient_matrix_is_the_mean_slope_of_every_quarter_of_an_annulus():
    geometry = PupilGeometry(8.0, 1.116)
    u = (np.arange(1200) - 599.5) / 150
    x, y = np.meshgrid(u, u)
    radius = np.hypot(x, y)
    clear = (radius < 4) & (radius > 0.558)
    step = 1e-4
    for column, noll in enumerate(NOLLS):
        along_x, along_y = (
            (
                zernike_basis((noll,), (x + a) / 4, (y + b) / 4)[0]
                - zernike_basis((noll,), (x - a) / 4, (y - b) / 4)[0]
            )
            * 1e-9
            / (2 * step)
            for a, b in ((step, 0), (0, step))
        )
        for lenslet, (right, up) in enumerate(SIDES):
            part = clear & (x * right > 0) & (y * up > 0)
            expected_mas = np.array([along_x[part].mean(), along_y[part].mean()]) / MAS_RAD
            found = gradient_matrix(geometry)[2 * lenslet : 2 * lenslet + 2, column]
            assert found == pytest.approx(expected_mas, abs=2e-4 * np.abs(gradient_matrix(geometry)).max())


def test_modes_of_noise_free_images_come_back_within_the_gain_of_the_threshold():
    settings = PsfSettings(UT4, (36, 36), 78.0, ((1600.0, 1.0),), KnownWavefront(), 80, lenslets=2)
    model = LensletArray(settings.for_broad_images(), NOLLS, dtype=torch.float64)
    modes = torch.tensor([[50.0, -40.0, 60.0, 30.0, -35.0]], dtype=torch.float64)
    images = 1e6 * model.images(modes).numpy()
    found = modes_of_centroids_nm(images, UT4, 78.0, noise_e=1.0)[0]
    assert found == pytest.approx(modes[0].numpy(), rel=0.25, abs=3)
