"""Robust fits of the frames of a cube, which share their linearisation.

Truth: scipy's BFGS on the loss of the same images in float64 with its gradient from automatic differentiation
(other minimiser, other derivatives), finite differences, and the same fits in one thread. That the wavefronts
are the right ones where the model is, test_calibration.py holds.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases
from scipy.optimize import minimize

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.image_fit import ImageFit, Layout
from irlos_pipe.estimate.methods import fit_frames
from irlos_pipe.numerics.loss import LOSSES
from irlos_pipe.numerics.parallel import workers
from irlos_pipe.numerics.solution import CONVERGED
from irlos_pipe.optics.psf import PsfModel

NOLLS = tuple(range(2, 12))
DRAWN = tuple(range(2, 31))
FRAMES, FLUX, SCATTER_NM = 12, 3e6, 15.0


def problem(dtype=torch.float32, frames: int = FRAMES) -> tuple[ImageFit, torch.Tensor]:
    """Frames with modes that the fitted model misses, and the coefficients of those it has."""
    rng = np.random.default_rng(7)
    scatter_nm = SCATTER_NM * torch.as_tensor(rng.standard_normal((frames, len(DRAWN))))
    true = cases.vector(cases.ncpa_nm(4, 30), DRAWN) + scatter_nm
    sampled = cases.settings(32).for_single_frames()
    clean = PsfModel(sampled, DRAWN).images(true).double().clamp_min(0).numpy() * FLUX
    drawn = torch.cat([cases.draw_frames(image, 1, seed=k) for k, image in enumerate(clean)])
    images = drawn.flatten(1)[:, None].to(dtype)
    variance = cases.READ_NOISE.variance_e2(images.double().mean(0, keepdim=True))
    model = ImageModel(PsfModel(sampled, NOLLS, dtype=dtype))
    return ImageFit(model, Layout(NOLLS), images, variance, loss=LOSSES["l1"]), true[:, : len(NOLLS)]


def start(fit: ImageFit, true_nm: torch.Tensor) -> torch.Tensor:
    return fit.layout.start(fit.images[:, 0], true_nm.mean(0))


@pytest.fixture(scope="module")
def solved():
    fit, true = problem()
    return fit, true, fit_frames(fit, start(fit, true), max_iterations=60)


def test_every_frame_reaches_the_loss_that_an_independent_minimiser_reaches(solved):
    found = solved[-1]
    exact, _ = problem(torch.float64)
    assert set(found.status) == {CONVERGED}
    for frame in (0, 5, 11):
        best = minimum(exact, found.values[frame], frame)
        reached = exact.objective(found.values[frame : frame + 1], torch.tensor([frame])).item()
        assert reached < 1.002 * best


def minimum(fit: ImageFit, near: torch.Tensor, frame: int) -> float:
    """Lowest loss about some parameters, by scipy."""
    which = torch.tensor([frame])
    scale = torch.cat([torch.full((len(NOLLS),), 5.0), torch.tensor([1e4, 1.0])])

    def loss(u: np.ndarray) -> tuple[float, np.ndarray]:
        v = torch.as_tensor(u).requires_grad_()
        value = fit.objective(near + scale * v[None], which).sum()
        value.backward()
        return value.item(), v.grad.numpy()

    return minimize(loss, np.zeros(len(scale)), jac=True, method="BFGS").fun


def test_results_are_the_same_to_the_bit_for_any_number_of_workers(solved):
    fit, true, found = solved
    with workers(2):
        again = fit_frames(fit, start(fit, true), max_iterations=60)
    assert torch.equal(again.values, found.values)
    assert again.status == found.status


def test_the_gradient_is_that_of_finite_differences():
    fit, true = problem(torch.float64, frames=2)
    x, both = start(fit, true), torch.arange(2)
    value, gradient = fit.gradient(x, both)
    assert value.numpy() == pytest.approx(fit.objective(x, both).numpy(), rel=1e-12)
    for column, step in [(0, 1e-3), (5, 1e-3), (len(NOLLS), 1.0), (len(NOLLS) + 1, 1e-3)]:
        move = torch.zeros_like(x)
        move[:, column] = step
        numeric = (fit.objective(x + move, both) - fit.objective(x - move, both)) / (2 * step)
        assert gradient[:, column].numpy() == pytest.approx(numeric.numpy(), rel=1e-4)
