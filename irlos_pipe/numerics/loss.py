"""Losses of whitened residuals: a value for the line search, a weight for Gauss–Newton, normal equations.

Every loss is written as ``ρ(r)`` with ``ρ ≈ r²/2`` for small residuals. Its weight ``w = ρ'(r)/r`` gives the
gradient, and as a curvature iteratively re-weighted least squares, which never raises the objective
(Holland & Welsch 1977).

For a robust loss in normal equations the images are replaced by their tangents, residuals
``r(δ) = r - √w J δ``. The minimum of this problem takes a few Newton steps, which cost much less than the
next Jacobian would. The step that leads there is what the solver is given, in the guise of normal equations.
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


TILE = 16  # rows in which matrix products are quick: with 31 of them a product takes twice as long as with 32
FEW = 12  # rows that are quick without padding
NEWTON_STEPS = 2
FRACTIONS = (1.0, 0.5, 0.25)  # parts of a Newton step: where residuals are few it leaps too far


def normal_equations(
    columns: torch.Tensor, residual: torch.Tensor, root: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return gradient (b, p), summed in float64, and Hessian (b, p, p), as precise as the derivatives.

    The Hessian only shapes steps. Derivatives of the images are `columns` (b, p, pixels), the whitened
    `residual` is (b, repeats, pixels), and `root` (b, repeats or 1, pixels) are square roots of the weights.
    """
    size = columns.shape[1]
    if residual.shape[1] > 1:  # images that share derivatives, like one image with their mean residual
        weight = (root * root).expand_as(residual).sum(1, keepdim=True)
        force, root = (residual * root).sum(1, keepdim=True), weight.sqrt()
        residual = torch.where(weight > 0, force / root, 0.0)
    columns = columns * root.to(columns.dtype)
    gradient = _sums(columns, residual[:, 0])
    if size > FEW:
        columns = torch.nn.functional.pad(columns, (0, 0, 0, -size % TILE))
    return -gradient, torch.bmm(columns, columns.mT)[:, :size, :size].double()


def _sums(columns: torch.Tensor, residual: torch.Tensor) -> torch.Tensor:
    """Sums over pixels of weighted derivatives times residuals (b, pixels), (b, p), float64.

    Products need no more digits than the derivatives have; a copy of these in float64 would take longer.
    """
    residual = residual.to(columns.dtype)
    if columns.dtype == torch.float64:
        return torch.bmm(columns, residual[..., None])[..., 0]
    return (columns * residual[:, None]).sum(2, dtype=torch.float64)


def robust_equations(
    columns: torch.Tensor,
    residual: torch.Tensor,
    root: torch.Tensor,
    loss: Loss,
    precision: torch.Tensor,
    offset: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return gradient (b, p) and Hessian (b, p, p), float64, with their minimum where the tangents have it.

    For `columns`, `residual` and `root` see `normal_equations`. The Gaussian prior has a `precision` and the
    parameters an `offset` from its mean, (b, parameters) each. All is in the precision of the derivatives: it
    shapes steps, which are only to lead near the minimum.
    """
    size = columns.shape[1]
    padded = torch.nn.functional.pad(columns, (0, 0, 0, -size % TILE))
    residual, root = residual.to(columns.dtype), root.to(columns.dtype)
    step = torch.zeros_like(offset)
    for _ in range(NEWTON_STEPS):
        weight = (loss.curvature(residual) * root**2).sum(1)
        products = (padded * weight[:, None]) @ padded.mT
        hessian = products[:, :size, :size].double() + torch.diag_embed(precision)
        force = (loss.weight(residual) * residual * root).sum(1)
        slope = (columns @ force[..., None])[..., 0]
        ahead = -_solve(hessian, precision * (offset + step) - slope.double())
        # the best of a few fractions of the step
        change = (ahead[:, None].to(residual.dtype) @ columns) * root
        losses = [loss.value(residual - part * change).sum((1, 2), dtype=torch.float64) for part in FRACTIONS]
        best = torch.tensor(FRACTIONS).to(change)[torch.stack(losses).argmin(0)]
        residual = residual - best[:, None, None] * change
        step = step + best[:, None].double() * ahead
    return -(hessian @ step[..., None])[..., 0], hessian


def _solve(hessian: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
    """``H⁻¹ g`` of a Hessian that may lack information in some direction."""
    scale = torch.diagonal(hessian, dim1=1, dim2=2).clamp_min(1e-300).rsqrt()
    scaled = hessian * scale[:, :, None] * scale[:, None, :]
    scaled = scaled + 1e-6 * torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
    return scale * torch.linalg.solve_ex(scaled, (scale * gradient)[..., None])[0][..., 0]
