"""Loss functions of whitened residuals: a value for the line search, a weight for Gauss–Newton.

Every loss is written as ``ρ(r)`` with ``ρ ≈ r²/2`` for small residuals. Its weight ``w = ρ'(r)/r`` gives the
gradient, and as a curvature iteratively re-weighted least squares, which never raises the objective
(Holland & Welsch 1977).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from irlos_pipe.conventions.late import torch

HUBER_KNEE = 2.0  # residuals beyond this many sigma count linearly
L1_ROUNDING = 1.0  # the kink of |r| is rounded over this many sigma: noise blurs a sharper one anyway
STEP = 1e-4  # step in σ over which ψ is differentiated; its curvature is of the order of one
LossName = Literal["gaussian", "huber", "l1"]


@dataclass(frozen=True)
class Loss:
    """A loss and its weight function."""

    name: LossName
    # whether residuals are divided by their standard error, or all count in electrons, as in the mean
    # absolute error of the paper
    whitened: bool
    value: Callable[[torch.Tensor], torch.Tensor]  # ``ρ(r)``
    weight: Callable[[torch.Tensor], torch.Tensor]  # ``ρ'(r)/r``
    # what stands for ``ρ''(r)`` in a Hessian, given residuals (b, repeats, pixels); positive
    curvature: Callable[[torch.Tensor], torch.Tensor]
    # fall of the loss, relative to itself, at which a fit counts as converged (besides the statistical
    # criterion of `solve`); re-weighting reaches an L1 minimum only linearly
    relative_tolerance: float = 0.0

    @property
    def quadratic(self) -> bool:
        """True for plain least squares, whose weights are all one."""
        return self.weight is _ones

    def slope(self, r: torch.Tensor) -> torch.Tensor:
        """Derivative of ``ψ = ρ'`` at residuals of any shape, by differences: exactly, where ψ is linear."""
        ahead, behind = r + STEP, r - STEP
        return (self.weight(ahead) * ahead - self.weight(behind) * behind) / (2 * STEP)


def _ones(r: torch.Tensor) -> torch.Tensor:
    return torch.ones_like(r)


def _huber(r: torch.Tensor) -> torch.Tensor:
    size = r.abs()
    return torch.where(size <= HUBER_KNEE, 0.5 * r * r, HUBER_KNEE * (size - 0.5 * HUBER_KNEE))


def _huber_weight(r: torch.Tensor) -> torch.Tensor:
    return HUBER_KNEE / r.abs().clamp_min(HUBER_KNEE)


def _l1_curvature(r: torch.Tensor) -> torch.Tensor:
    """The kink of |r|, rounded as widely as the residuals scatter: Newton's weight and the re-weighting's.

    The curvature of a sum of |r| is the density of residuals at zero. ``1/|r|`` exceeds it several
    times, and steps become short; the mean of both is close to it and does not leap where residuals are few.
    """
    width = r.abs().mean((1, 2), keepdim=True) + L1_ROUNDING
    rounded = torch.rsqrt(r * r + width**2)
    return 0.5 * (rounded + width**2 * rounded**3)


GAUSSIAN = Loss("gaussian", True, lambda r: 0.5 * r * r, _ones, _ones)
HUBER = Loss("huber", True, _huber, _huber_weight, _huber_weight)
L1 = Loss(
    "l1",
    False,
    lambda r: torch.sqrt(r * r + L1_ROUNDING**2) - L1_ROUNDING,
    lambda r: torch.rsqrt(r * r + L1_ROUNDING**2),
    _l1_curvature,
    relative_tolerance=2e-4,
)
LOSSES: dict[str, Loss] = {loss.name: loss for loss in (GAUSSIAN, HUBER, L1)}
