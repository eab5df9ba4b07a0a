"""Losses. Truth: automatic differentiation, the written definitions, and known estimators of location."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from irlos_pipe.numerics.loss import L1_ROUNDING, LOSSES

RESIDUALS = torch.cat([-torch.logspace(2, -3, 60), torch.logspace(-3, 2, 60)]).double()
each_loss = pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)


@each_loss
def test_the_weight_is_the_slope_over_the_residual(loss):
    r = RESIDUALS.clone().requires_grad_()
    loss.value(r).sum().backward()
    assert (loss.weight(RESIDUALS) * RESIDUALS).numpy() == pytest.approx(r.grad.numpy(), rel=1e-9)


@each_loss
def test_reweighted_least_squares_bounds_the_loss_from_above(loss):
    """The reason why re-weighting never raises the objective."""
    for at in (0.01, 0.5, 3.0, 50.0):
        here = torch.tensor([at], dtype=torch.float64)
        bound = loss.value(here) + loss.weight(here) * (RESIDUALS**2 - at**2) / 2
        assert (loss.value(RESIDUALS) <= bound + 1e-9).all()


def test_l1_is_the_absolute_value_but_for_its_rounded_kink():
    r = RESIDUALS
    assert (r.abs() - LOSSES["l1"].value(r)).numpy() == pytest.approx(
        np.full(len(r), L1_ROUNDING), abs=L1_ROUNDING
    )
    far = 2000 * L1_ROUNDING
    assert LOSSES["l1"].value(torch.tensor([far])).item() == pytest.approx(far, rel=1e-3)


def location(data: torch.Tensor, loss) -> float:
    """Position that minimises the loss, by re-weighting."""
    at = data.mean()
    for _ in range(500):
        weight = loss.weight(data - at)
        at = (weight * data).sum() / weight.sum()
    return float(at)


def test_an_outlier_pulls_the_robust_losses_least():
    data = torch.as_tensor(np.random.default_rng(4).standard_normal(200))
    hit = torch.cat([data, torch.tensor([1e4], dtype=torch.float64)])
    pull = {name: abs(location(hit, loss) - location(data, loss)) for name, loss in LOSSES.items()}
    assert pull["gaussian"] > 40
    assert pull["huber"] < 0.1 and pull["l1"] < 0.1


@pytest.mark.parametrize("scatter", [20 * L1_ROUNDING, 400 * L1_ROUNDING])
def test_the_curvature_of_l1_is_about_the_density_of_residuals_at_zero(scatter):
    """Which is √(2/π) over the standard deviation for each normal residual; 1/|r| exceeds it three times."""
    r = scatter * torch.as_tensor(np.random.default_rng(1).standard_normal((1, 1, 4000)))
    curvature = LOSSES["l1"].curvature(r).mean().item()
    assert 0.8 < curvature / (np.sqrt(2 / np.pi) / scatter) < 1.3
