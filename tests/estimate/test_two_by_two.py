"""LIFT on the four images of a 2x2 mode, what they determine, and defocus from their centroids.

Truth: wavefronts put into the model itself with Gaussian noise, so these tests share all assumptions of the
model; `tests/simulate/test_simulate_imaging.py` compares its images with those of the simulator. Of
centroids: mean slopes by numerical integration, and images of known wavefronts.
"""

import numpy as np
import pytest
import torch
from helpers.lenslet_cases import lenslet_settings

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.lenslet_images import SIGMA_MAS, LensletImages
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.lenslets import NOLLS, SIDES, gradient_matrix, identified, modes_of_centroids_nm
from irlos_pipe.estimate.lift import lift
from irlos_pipe.estimate.sensitivity import cramer_rao_nm
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.lenslets import LensletArray
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.optics.zernike import zernike_basis

SETTINGS = lenslet_settings(24)
NOISE, GOOD = NoiseModel(1.25, 4.0), torch.ones(24, 24, dtype=torch.bool)


@pytest.fixture(scope="module")
def model() -> ImageModel:
    return ImageModel(LensletArray(SETTINGS, (2, 3, 4, 5, 6), dtype=torch.float64))


@pytest.mark.slow
@pytest.mark.parametrize("defocus_nm", [-250.0, 80.0])
def test_defocus_has_the_right_sign_and_the_scatter_of_the_cramer_rao_bound(model, defocus_nm):
    frames, flux = 40, 3e4
    truth = torch.tensor([[20.0, -30.0, defocus_nm, 25.0, -20.0]], dtype=torch.float64)
    mean = model.predict(truth, torch.tensor([flux]).double(), torch.zeros(1).double())
    noise = torch.randn(frames, 24, 24, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    images = mean + noise * NOISE.variance_e2(mean).sqrt()
    result = lift(model, images, GOOD, NOISE, torch.zeros(frames, 5, dtype=torch.float64))
    bound = cramer_rao_nm(model, truth, torch.tensor([flux]), NOISE)[0]
    errors = result.zernike_nm - truth
    assert bool(result.solution.converged.all())
    assert errors.mean(0).abs().numpy() == pytest.approx(
        np.zeros(5), abs=4 * float(bound.max()) / frames**0.5
    )
    assert (errors.std(0) / bound).numpy() == pytest.approx(np.ones(5), abs=0.45)  # 40 frames: 11 %


def test_what_displaced_images_leave_of_defocus_is_their_prior_over_the_gradient(model):
    """A prior of σ on eight displacements is σ/|g| on the mode with displacements g per nm, beside the noise.

    Of a faint star: the shape of bright images tells defocus from displacements.
    """
    flux, nothing = torch.tensor([3e4]).double(), torch.zeros(1, dtype=torch.float64)
    image = model.predict(torch.zeros(1, 5, dtype=torch.float64), flux, nothing)
    frames, loose, focus = Frames(image, GOOD, NOISE), np.full(5, 1e4), model.psf.nolls.index(4)
    free = ImageModel(model.psf, [LensletImages()])
    held_nm = identified(model, {}, torch.zeros(0).double(), frames, loose).bound_nm[focus]
    found_nm = identified(free, {}, torch.zeros(12).double(), frames, loose).bound_nm[focus]
    by_prior_nm = SIGMA_MAS / np.linalg.norm(gradient_matrix(SETTINGS.geometry)[:, focus])
    assert found_nm == pytest.approx(np.hypot(held_nm, by_prior_nm), rel=0.05)


# -- centroids -----------------------------------------------------------------------------------


MAS_RAD = np.pi / 180 / 3600e3
UT4 = load_instrument("irlos").pupil


@pytest.mark.slow
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
