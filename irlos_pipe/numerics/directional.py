"""Derivatives along one direction, or along all, by differentiating backwards twice.

The product Jᵀu is linear in u, and its derivative with respect to u, times a direction d, is Jd. Dual
numbers give the same in one pass, but PyTorch keeps one level of them per process, so that threads take
turns, and loads for seconds before the first.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TypeAlias

from irlos_pipe.conventions.late import torch

Function: TypeAlias = "Callable[[torch.Tensor], torch.Tensor]"


class Directional:
    """Derivatives of a real or complex function at real `values`, where it is evaluated once."""

    def __init__(self, function: Function, values: torch.Tensor):
        with torch.enable_grad():
            at = values.detach().clone().requires_grad_()
            self.result = function(at)
            real = torch.view_as_real(self.result) if self.result.is_complex() else self.result
            self.size, self.pulled = at.shape, None
            if real.requires_grad:
                self.factors = torch.zeros_like(real, requires_grad=True)
                (self.pulled,) = torch.autograd.grad(real, at, self.factors, create_graph=True)

    def along(self, direction: torch.Tensor) -> torch.Tensor:
        """Return the derivative along a `direction` in the argument, of the shape of the function."""
        if self.pulled is None or not self.pulled.requires_grad:
            return torch.zeros_like(self.result).detach()
        (change,) = torch.autograd.grad(
            self.pulled, self.factors, direction.to(self.pulled), retain_graph=True, materialize_grads=True
        )
        return torch.view_as_complex(change.contiguous()) if self.result.is_complex() else change

    def by(self, index: int) -> torch.Tensor:
        """Return the derivative with respect to the element `index` of the argument, a vector."""
        direction = torch.zeros(self.size, dtype=torch.float64)
        direction[index] = 1
        return self.along(direction)


def along_all(function: Function, values: torch.Tensor) -> torch.Tensor:
    """Return those of a real or complex `function` by all elements of `values`, elements first."""
    change = Directional(function, values)
    return torch.stack([change.by(index) for index in range(len(values))])


def with_pullback(values: torch.Tensor, function: Function, pullback: Callable) -> torch.Tensor:
    """Return a real `function` of `values`, and let autograd use ``pullback(values, upstream)`` for it.

    That is the product of its transposed Jacobian with derivatives by what it returns, and linear in these.
    """
    return _stated().apply(values, function, pullback)


@cache
def _stated() -> type[torch.autograd.Function]:
    """What `with_pullback` applies; torch is loaded late."""

    class Stated(torch.autograd.Function):
        @staticmethod
        def forward(values, function, pullback):
            return function(values)

        @staticmethod
        def setup_context(ctx, inputs, output):
            values, _, ctx.pullback = inputs
            ctx.save_for_backward(values)

        @staticmethod
        def backward(ctx, upstream):
            return ctx.pullback(*ctx.saved_tensors, upstream), None, None

    return Stated
