"""Normal equations. Truth: the sums written out in float64."""

from __future__ import annotations

import pytest
import torch

from irlos_pipe.numerics.normal_equations import normal_equations

PIXELS = 400


def problem(parameters: int, repeats: int, own_weights: bool):
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
    columns, residual, root = problem(parameters, repeats, own_weights)
    weight = (root**2).expand_as(residual)
    expected_slope = -torch.einsum("bpx,brx,brx->bp", columns, residual, root.expand_as(residual))
    expected_hessian = torch.einsum("bpx,brx,bqx->bpq", columns, weight, columns)
    gradient, hessian = normal_equations(columns.to(dtype), residual.to(dtype), root.to(dtype))
    rounding = PIXELS**0.5 * torch.finfo(dtype).eps * repeats
    assert gradient.dtype == hessian.dtype == torch.float64
    assert (gradient - expected_slope).abs().max() < 20 * rounding
    assert (hessian - expected_hessian).abs().max() < 20 * rounding * expected_hessian.abs().max()
