"""Derivatives along one direction, or along all, by dual numbers.

PyTorch keeps one level of dual numbers per process, not per thread: threads take turns.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeAlias

from irlos_pipe.conventions.late import LateModule, torch

forward_ad = LateModule("torch.autograd.forward_ad")
Function: TypeAlias = "Callable[[torch.Tensor], torch.Tensor]"

_turn = threading.RLock()


def pushed(function: Function, values: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """Return the derivative of `function` at `values` along a `direction` in its argument."""
    with _turn, forward_ad.dual_level():
        dual = forward_ad.unpack_dual(function(forward_ad.make_dual(values.clone(), direction.to(values))))
        return torch.zeros_like(dual.primal) if dual.tangent is None else dual.tangent.clone()


def pushed_all(function: Function, values: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Return those of `function` at `values` along several `directions`, the second axis there and here.

    The function gets its argument with that axis, and must make the same of every element along it.
    """
    repeated = values.unsqueeze(1).expand_as(directions).contiguous()
    return pushed(function, repeated, directions)


def along(function: Function, values: torch.Tensor, index: int) -> torch.Tensor:
    """Return the derivative of `function` at `values` with respect to the element `index`."""
    direction = torch.zeros_like(values)
    direction[index] = 1
    return pushed(function, values, direction)


def along_all(function: Function, values: torch.Tensor) -> torch.Tensor:
    """Return those of a real or complex `function` by all elements of `values`, elements first."""
    return torch.stack([along(function, values, index) for index in range(len(values))])
