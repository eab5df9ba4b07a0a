"""Loss functions of whitened residuals: a value for the line search, a weight for Gauss–Newton.

Every loss is written as ``ρ(r)`` with ``ρ ≈ r²/2`` for small residuals, and minimised by
iteratively re-weighted least squares with ``w = ρ'(r)/r``, which never raises the objective
(Holland & Welsch 1977).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

HUBER_KNEE = 2.0  # residuals beyond this many sigma count linearly
L1_ROUNDING = 0.05  # the kink of |r| is rounded below this many sigma


@dataclass(frozen=True)
class Loss:
    """A loss and its weight function.

    Attributes
    ----------
    name : str
    whitened : bool
        True if residuals are divided by their standard error, False if they count in
        electrons alike (as the mean absolute error of the paper does).
    value, weight : callable
        ``ρ(r)`` and ``ρ'(r)/r``.
    relative_tolerance : float
        Fall of the loss, relative to itself, at which a fit counts as converged (besides the
        statistical criterion of `solve`); re-weighting reaches an L1 minimum only linearly.
    """

    name: str
    whitened: bool
    value: Callable[[torch.Tensor], torch.Tensor]
    weight: Callable[[torch.Tensor], torch.Tensor]
    relative_tolerance: float = 0.0

    @property
    def quadratic(self) -> bool:
        """True for plain least squares, whose weights are all one."""
        return self.weight is torch.ones_like


def _huber(r: torch.Tensor) -> torch.Tensor:
    size = r.abs()
    return torch.where(size <= HUBER_KNEE, 0.5 * r * r, HUBER_KNEE * (size - 0.5 * HUBER_KNEE))


GAUSSIAN = Loss("gaussian", True, lambda r: 0.5 * r * r, torch.ones_like)
HUBER = Loss("huber", True, _huber, lambda r: HUBER_KNEE / r.abs().clamp_min(HUBER_KNEE))
L1 = Loss(
    "l1",
    False,
    lambda r: torch.sqrt(r * r + L1_ROUNDING**2) - L1_ROUNDING,
    lambda r: torch.rsqrt(r * r + L1_ROUNDING**2),
    relative_tolerance=1e-3,
)
LOSSES = {loss.name: loss for loss in (GAUSSIAN, HUBER, L1)}
