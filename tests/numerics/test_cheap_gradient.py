"""The gradient by reverse-mode differentiation.

Truth: the gradient from Jacobians, which `test_effects_tangents` holds against finite
differences.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.effect_cases import NOLLS, SPECTRUM, STRONG, WINDOW, made
from helpers.optics_cases import ncpa_nm, settings

from irlos_pipe.diagnosis.fitted import JointFit
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.image_fit import ImageFit, Layout
from irlos_pipe.optics.psf import PsfModel

# Beyond the edge of the pupil as built, where a displaced stop lets light pass, the wavefront of the images
# ends and that of the Jacobian goes on.
LEFT = {"pupil_misregistration": 2e-5}
ONE = torch.arange(1)
FLUX_E, BACKGROUND_E, NOISE_E2 = 1e6, 30.0, 100.0


def star() -> PsfModel:
    """Two colours of both bands, float64."""
    return PsfModel(
        settings(WINDOW, SPECTRUM, margin_mas=150.0, halo_margin_mas=250.0), NOLLS, dtype=torch.float64
    )


@pytest.mark.parametrize("name", sorted(STRONG.keys() - {"correlated_noise"}))
@pytest.mark.slow
def test_the_cheap_gradient_is_that_of_the_normal_equations(name):
    effect, values = made(name)
    model = ImageModel(star(), [effect])
    known = ncpa_nm(3, NOLLS[-1], 80.0)
    modes = torch.tensor([[known.get(noll, 0.0) for noll in NOLLS]], dtype=torch.float64)
    layout = Layout(NOLLS, model.effects.parameters, prior_sigma_nm=torch.full((len(NOLLS),), 200.0))
    noise = np.random.default_rng(1).normal(0, 40, (1, 1, WINDOW[0] * WINDOW[1]))
    data = ImageModel(star()).predict(modes, torch.tensor([FLUX_E]), torch.tensor([BACKGROUND_E]))
    data = data.flatten(1)[:, None] + torch.as_tensor(noise)
    problem = JointFit([ImageFit(model, layout, data, torch.full_like(data, NOISE_E2))])
    x = torch.cat([modes, values[None], torch.tensor([[1.02 * FLUX_E, BACKGROUND_E]])], dim=1)
    value, gradient, hessian = problem.normal_equations(x, ONE)
    cheap_value, cheap_gradient = problem.cheap_gradient(x, ONE)
    assert float(cheap_value) == pytest.approx(float(value), rel=1e-12)
    unit = torch.diagonal(hessian[0]).sqrt()
    slopes, cheap = (one[0] / unit for one in (gradient, cheap_gradient))
    assert cheap.numpy() == pytest.approx(slopes.numpy(), abs=LEFT.get(name, 1e-6) * float(slopes.norm()))
