"""Derivatives along one direction, or along all, by dual numbers.

PyTorch keeps one level of dual numbers per process, not per thread: threads take turns.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial

import torch
from torch.autograd import forward_ad

Function = Callable[[torch.Tensor], torch.Tensor]

_turn = threading.RLock()


def pushed(function: Function, values: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """Return the derivative of `function` at `values` along a `direction` in its argument."""
    with _turn:
        return torch.func.jvp(function, (values,), (direction,))[1]


def pushed_all(function: Function, values: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Return those of `function` at `values` along several `directions`, the second axis there and here."""
    with _turn:
        return torch.func.vmap(partial(pushed, function, values), in_dims=1, out_dims=1)(directions)


def along(function: Function, values: torch.Tensor, index: int) -> torch.Tensor:
    """Return the derivative of `function` at `values` with respect to the element `index`."""
    direction = torch.zeros_like(values)
    direction[index] = 1
    return pushed(function, values, direction)


def along_all(function: Function, values: torch.Tensor) -> torch.Tensor:
    """Return those of a real or complex `function` by all elements of `values`, elements first."""
    with _turn:
        if len(values) == 1:  # dual numbers cost much less than the vectorised transform
            with forward_ad.dual_level():
                dual = function(forward_ad.make_dual(values, torch.ones_like(values)))
                return forward_ad.unpack_dual(dual).tangent[None]
        return _vectorised(function, values)


def _vectorised(function: Function, values: torch.Tensor) -> torch.Tensor:
    is_complex = function(values).is_complex()

    def parts(v: torch.Tensor) -> torch.Tensor:
        return torch.view_as_real(function(v)) if is_complex else function(v)

    slopes = torch.func.jacfwd(parts)(values).movedim(-1, 0).contiguous()
    return torch.view_as_complex(slopes) if is_complex else slopes
