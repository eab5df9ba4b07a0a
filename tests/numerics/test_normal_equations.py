"""Normal equations, and where linearised fits lead.

Truth: scipy's minimiser on the written loss of the same linear problem (independent), weighted least squares
solved directly (analysis), and the sums written out in float64.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from irlos_pipe.numerics.loss import LOSSES
from irlos_pipe.numerics.normal_equations import Linearised, normal_equations
from irlos_pipe.numerics.problem import CHI2_TOLERANCE

PARAMETERS, PIXELS = 3, 400


@pytest.fixture
def parts():
    """Derivatives, heavy-tailed whitened residuals, square roots of weights, prior precision and offset."""
    rng = np.random.default_rng(4)
    columns = torch.as_tensor(rng.standard_normal((1, PARAMETERS, PIXELS)))
    residual = torch.as_tensor(5 * rng.standard_t(3, (1, 1, PIXELS)) + 4.0 * columns[:, :1].numpy())
    root = torch.as_tensor(rng.uniform(0.5, 1.5, (1, 1, PIXELS)))
    return columns, residual, root, torch.full((1, PARAMETERS), 2.0), torch.full((1, PARAMETERS), 0.3)


def objective(parts, loss, step: np.ndarray) -> float:
    columns, residual, root, precision, offset = parts
    moved = residual[0, 0] - root[0, 0] * (torch.as_tensor(step) @ columns[0])
    prior = 0.5 * (precision[0] * (offset[0] + torch.as_tensor(step)) ** 2).sum()
    return float(loss.value(moved).sum() + prior)


def step_of(gradient: torch.Tensor, hessian: torch.Tensor) -> np.ndarray:
    return -torch.linalg.solve(hessian, gradient[..., None])[0, :, 0].numpy()


def test_the_equations_of_least_squares_are_exact(parts):
    columns, residual, root, precision, offset = parts
    problem = Linearised(columns, residual, root, LOSSES["gaussian"], precision, offset)
    gradient, hessian = problem.normal_equations()
    whitened = (columns * root)[0].numpy()
    expected = whitened @ whitened.T + np.diag(precision[0])
    assert hessian[0].numpy() == pytest.approx(expected, rel=1e-12)
    slope = precision[0] * offset[0] - torch.as_tensor(whitened @ residual[0, 0].numpy())
    assert gradient[0].numpy() == pytest.approx(slope.numpy(), rel=1e-12)


@pytest.mark.parametrize("name", ["l1", "huber"])
def test_the_step_of_a_robust_loss_reaches_most_of_the_fall_that_there_is(parts, name):
    loss = LOSSES[name]
    columns, residual, root, precision, offset = parts
    found = step_of(*Linearised(columns, residual, root, loss, precision, offset).normal_equations())
    best = minimize(lambda s: objective(parts, loss, s), np.zeros(PARAMETERS), method="Nelder-Mead").fun
    here = objective(parts, loss, np.zeros(PARAMETERS))
    fall = here - objective(parts, loss, found)
    assert fall > 0.9 * (here - best)


@pytest.mark.parametrize("name", ["l1", "huber"])
def test_repeated_steps_end_where_an_independent_minimiser_does(parts, name):
    loss = LOSSES[name]
    columns, residual, root, precision, offset = parts
    total = np.zeros(PARAMETERS)
    for _ in range(20):
        moved = residual - root * (torch.as_tensor(total) @ columns[0])
        problem = Linearised(columns, moved, root, loss, precision, offset + torch.as_tensor(total))
        total = total + step_of(*problem.normal_equations())
    tight = {"xatol": 1e-8, "fatol": 1e-10}
    best = minimize(lambda s: objective(parts, loss, s), total + 0.1, method="Nelder-Mead", options=tight)
    assert objective(parts, loss, total) - best.fun < 0.5 * CHI2_TOLERANCE


# -- the sums ------------------------------------------------------------------------------------


def drawn_problem(parameters: int, repeats: int, own_weights: bool):
    """Derivatives, residuals and roots of weights, some pixels masked in all images and some in a few."""
    draw = torch.Generator().manual_seed(parameters + 10 * repeats)
    columns = torch.randn(3, parameters, PIXELS, generator=draw, dtype=torch.float64)
    residual = torch.randn(3, repeats, PIXELS, generator=draw, dtype=torch.float64)
    root = torch.rand(3, repeats if own_weights else 1, PIXELS, generator=draw, dtype=torch.float64)
    root[:, :, :20] = 0
    root[:, 0, 20:40] = 0
    return columns, residual * (root > 0), root


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("repeats", "own_weights"), [(1, True), (4, False), (4, True)])
@pytest.mark.parametrize("parameters", [5, 31])
def test_they_are_the_sums_over_images_and_pixels(parameters, repeats, own_weights, dtype):
    columns, residual, root = drawn_problem(parameters, repeats, own_weights)
    weight = (root**2).expand_as(residual)
    expected_slope = -torch.einsum("bpx,brx,brx->bp", columns, residual, root.expand_as(residual))
    expected_hessian = torch.einsum("bpx,brx,bqx->bpq", columns, weight, columns)
    gradient, hessian = normal_equations(columns.to(dtype), residual.to(dtype), root.to(dtype))
    rounding = PIXELS**0.5 * torch.finfo(dtype).eps * repeats
    assert gradient.dtype == hessian.dtype == torch.float64
    assert (gradient - expected_slope).abs().max() < 20 * rounding
    assert (hessian - expected_hessian).abs().max() < 20 * rounding * expected_hessian.abs().max()
