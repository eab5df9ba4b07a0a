"""Mirrored images are told by the vanes.

Truth: frames drawn from the model (same code, on purpose: the question is what the vanes tell), mirrored by
exchanging rows or columns; the scatter of the amplitude over draws of the noise.
"""

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases

from irlos_pipe.effects import FixedEffect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.redrawn_pupil import PupilMisregistration
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames, mean_variance_e2
from irlos_pipe.estimate.image_fit import ImageFit, Layout
from irlos_pipe.estimate.residual import Mirrored, mirrored
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf import PsfModel

NOLLS = tuple(range(2, 16))
CHANGES = {
    "as told": lambda images: images,
    "turned by 180°": lambda images: images.flip(1, 2),
    "left to right": lambda images: images.flip(2),
    "up and down": lambda images: images.flip(1),
}


def found(change: str, flux: float = 3e6, seed: int = 5) -> Mirrored:
    true = cases.vector(cases.ncpa_nm(4, highest_noll=15, total_nm=100.0), NOLLS)
    image = PsfModel(cases.settings(), NOLLS).images(true)[0].double().numpy() * flux
    images = torch.as_tensor(np.ascontiguousarray(CHANGES[change](cases.draw_frames(image, 24, seed=seed))))
    frames = Frames(images, cases.everything(images), NoiseModel(1.0, 1.0))
    options = CalibrationOptions(highest_noll=15, prior=cases.PRIOR)
    result = calibrate(frames, cases.settings(), options).mirrored
    assert result is not None
    return result


@pytest.mark.parametrize(("change", "amplitude"), [*zip(CHANGES, (0.0, 0.0, 1.0, 1.0), strict=True)])
def test_a_mirrored_image_shows_the_mirrored_pupil(change, amplitude):
    """Turned by 180° the vanes of UT4 stay where they are: that is what no image tells."""
    result = found(change)
    assert result.tells and abs(result.amplitude - amplitude) < 5 * result.sigma + 0.1
    assert result.seen == (amplitude == 1.0)


def test_a_parameter_without_effect_changes_nothing():
    """A stop at no distance has no direction: its derivative is zero, and the normal matrix is singular."""
    stop = FixedEffect(PupilMisregistration(), [0.0, 0.3, 0.0], free=("distance_m", "direction_rad"))
    model = ImageModel(PsfModel(cases.settings(), NOLLS, dtype=torch.float64), [stop])
    true, flux = cases.vector(cases.ncpa_nm(4, highest_noll=15, total_nm=100.0), NOLLS), 3e6
    image = PsfModel(cases.settings(), NOLLS).images(true)[0].double().numpy() * flux
    images = torch.as_tensor(cases.draw_frames(image, 24, seed=5))
    frames = Frames(images, cases.everything(images), NoiseModel(1.0, 1.0))
    mean, variance = frames.mean_e.flatten(), mean_variance_e2(frames).flatten()
    layout = Layout(NOLLS, model.effects.parameters)
    problem = ImageFit(model, layout, mean[None, None], variance[None, None])
    values = torch.cat([true[0], torch.tensor([0.0, 0.3, flux, 0.0], dtype=torch.float64)])[None]
    result = mirrored(frames, problem, values)
    assert result is not None and result.tells and abs(result.amplitude) < 5 * result.sigma


@pytest.mark.slow
def test_the_quoted_error_is_the_scatter_over_draws():
    some = [found("as told", flux=1e5, seed=seed) for seed in range(12)]
    pulls = [one.amplitude / one.sigma for one in some]
    assert 0.5 < np.std(pulls) < 1.7 and abs(np.mean(pulls)) < 1.0
