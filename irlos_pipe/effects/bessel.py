"""A Bessel function that PyTorch cannot differentiate by itself."""

from __future__ import annotations

from functools import cache

from irlos_pipe.conventions.late import torch


@cache
def _differentiable() -> type[torch.autograd.Function]:
    """``J0(2√w)``, analytic in w, with ``d/dw = -J1(2√w)/√w``, which is -1 at 0."""

    class J0OfTwiceRoot(torch.autograd.Function):
        @staticmethod
        def forward(w):
            return torch.special.bessel_j0(2 * torch.sqrt(w))

        @staticmethod
        def setup_context(ctx, inputs, output):
            ctx.save_for_backward(*inputs)

        @staticmethod
        def backward(ctx, change):
            return change * _slope(*ctx.saved_tensors)

    return J0OfTwiceRoot


def _slope(w: torch.Tensor) -> torch.Tensor:
    root = torch.sqrt(w)
    safe = torch.where(root > 1e-8, root, 1.0)
    return torch.where(root > 1e-8, -torch.special.bessel_j1(2 * safe) / safe, -1.0)


def j0_of_twice_root(w: torch.Tensor) -> torch.Tensor:
    """``J0(2√w)`` for w ≥ 0, differentiable everywhere."""
    return _differentiable().apply(w)
