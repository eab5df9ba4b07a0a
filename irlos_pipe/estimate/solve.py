"""Batched Levenberg–Marquardt: many independent, equally shaped least-squares problems at once.

The solver knows no physics. A problem gives the objective, its gradient and its
Gauss–Newton Hessian for a batch of parameter vectors, in units where the objective is half
a χ². "Converged" means that the step still available would lower χ² by a negligible amount g
(`CHI2_TOLERANCE`, in units of χ²/ν where the model misfits); as g = δᵀHδ, no parameter would
move by more than √g of its standard error, 3 %.

Where a model misfits, the curvature that Gauss–Newton neglects is not small, and convergence becomes linear.
What the gradients of successive iterations tell of it is added to the Hessian of the steps (Dennis, Gay &
Welsch 1981, ACM TOMS 7, 348); whether a member has converged, and its covariance, are judged without.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch

CHI2_TOLERANCE = 1e-3
ROUNDING = 1e-6  # relative rounding of an objective whose images are propagated in float32
DAMPING_START, DAMPING_MIN = 1e-3, 1e-9
MEMBERS_AT_ONCE = 256  # whose matrices are solved: some ten copies of each are made on the way
GOOD_STEP, POOR_STEP = 0.75, 0.25  # parts of the predicted fall that lower, or raise, the damping

CONVERGED, MAX_ITERATIONS, STALLED, INVALID = "converged", "max_iterations", "stalled", "invalid"


class Problem(Protocol):
    """A batch of least-squares problems; `which` selects members of the batch.

    A problem may have ``reweighted = True``: its equations are those of a re-weighted problem, whose
    quadratic model does not foretell the fall of the objective.
    """

    lower: torch.Tensor
    upper: torch.Tensor

    def negligible(self, value: torch.Tensor) -> torch.Tensor:
        """Predicted fall of twice the objective at which a member with this objective is done, (b,)."""

    def normal_equations(self, x: torch.Tensor, which: torch.Tensor):
        """Objective (b,), gradient (b, p) and Hessian (b, p, p), all float64."""

    def objective(self, x: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        """Objective (b,), comparable with that of the last `normal_equations` of the same members."""


@dataclass(frozen=True)
class Solution:
    """Outcome of a batch of fits.

    Attributes
    ----------
    values : tensor, (batch, parameters), float64
    covariance : tensor, (batch, parameters, parameters)
        Inverse of the Hessian at the solution (Cramér–Rao bound plus prior).
    status : list of str
        `converged`, `max_iterations`, `stalled` or `invalid`, one per member.
    iterations : tensor of int, (batch,)
    objective : tensor, (batch,)
        Half of χ² (prior included) at the solution.
    """

    values: torch.Tensor
    covariance: torch.Tensor
    status: list[str]
    iterations: torch.Tensor
    objective: torch.Tensor

    @property
    def converged(self) -> torch.Tensor:
        """True where the fit converged, (batch,)."""
        return torch.tensor([status == CONVERGED for status in self.status])

    @property
    def sigma(self) -> torch.Tensor:
        """Standard errors, (batch, parameters)."""
        return torch.diagonal(self.covariance, dim1=1, dim2=2).clamp_min(0).sqrt()


@torch.no_grad()
def solve(
    problem: Problem,
    start: torch.Tensor,
    *,
    max_iterations: int = 50,
    report: Callable[[int], None] | None = None,
) -> Solution:
    """Minimise a batch of problems from `start`, (batch, parameters).

    Parameters
    ----------
    report : callable, optional
        Called with the number of members that finished in each iteration (progress bars).

    Returns
    -------
    Solution
        Members that meet non-finite numbers are flagged `invalid`, never silently NaN.
    """
    state = _State(problem, start.double().clone())
    for _ in range(max_iterations):
        active = state.active()
        if len(active) == 0:
            break
        finished = state.iterate(active)
        if report is not None:
            report(finished)
    return state.solution()


class _State:
    """The batch while it is being solved; converged members are no longer evaluated."""

    def __init__(self, problem: Problem, x: torch.Tensor):
        self.problem = problem
        self.x = x.clamp(problem.lower, problem.upper)
        batch, size = x.shape
        self.damping = torch.full((batch,), DAMPING_START, dtype=torch.float64)
        self.status = [MAX_ITERATIONS] * batch
        self.iterations = torch.zeros(batch, dtype=torch.int64)
        self.value = torch.full((batch,), float("nan"), dtype=torch.float64)
        self.hessian = torch.eye(size, dtype=torch.float64).repeat(batch, 1, 1)
        self.gradient = torch.zeros(batch, size, dtype=torch.float64)
        self.neglected = torch.zeros_like(self.hessian)
        self.moved = torch.zeros(batch, size, dtype=torch.float64)
        self.reweighted = getattr(problem, "reweighted", False)

    def active(self) -> torch.Tensor:
        """Members that still move."""
        return torch.tensor([i for i, s in enumerate(self.status) if s == MAX_ITERATIONS], dtype=torch.int64)

    def iterate(self, which: torch.Tensor) -> int:
        """One linearisation and one accepted or refused step for every active member."""
        value, gradient, hessian = self.problem.normal_equations(self.x[which], which)
        finite = torch.isfinite(value) & torch.isfinite(gradient).all(1) & torch.isfinite(hessian).all((1, 2))
        self._close(which[~finite], INVALID)
        which, value, gradient, hessian = (t[finite] for t in (which, value, gradient, hessian))
        if not self.reweighted:
            change = gradient - self.gradient[which]
            self.neglected[which] = _secant(self.neglected[which], hessian, self.moved[which], change)
        self.value[which], self.gradient[which], self.hessian[which] = value, gradient, hessian
        self.iterations[which] += 1
        before = len(self.active())
        moving = self._check_convergence(which)
        if len(moving):
            self._step(moving)
        return int((~finite).sum()) + before - len(self.active())

    def _check_convergence(self, which: torch.Tensor) -> torch.Tensor:
        """Close members whose undamped step is negligible; return those that should step."""
        step = self._free_step(which, torch.zeros(len(which), dtype=torch.float64))
        gain = -(self.gradient[which] * step).sum(1)  # twice the predicted decrease of the objective
        value = self.value[which]
        small = gain < torch.maximum(self.problem.negligible(value), ROUNDING * value)
        self._close(which[small], CONVERGED)
        return which[~small]

    def _step(self, which: torch.Tensor) -> None:
        """Try damped steps, raising the damping until the objective falls."""
        for _ in range(12):
            step = self._descent(which)
            trial = (self.x[which] + step).clamp(self.problem.lower, self.problem.upper)
            taken = trial - self.x[which]
            value = self.problem.objective(trial, which)
            better = value <= self.value[which] * (1 + ROUNDING)  # False for NaN as well
            self.x[which[better]], self.moved[which[better]] = trial[better], taken[better]
            self._adapt_damping(which[better], taken[better], value[better])
            which = which[~better]
            if len(which) == 0:
                return
            self.damping[which] *= 10
        self._close(which, STALLED)

    def _adapt_damping(self, which: torch.Tensor, step: torch.Tensor, value: torch.Tensor) -> None:
        """Lower the damping where the quadratic model foretold the fall, raise it where it did not.

        In a noisy image the curvature that Gauss–Newton neglects can be as large as what it keeps. Full
        steps then leap across the minimum and back, and the objective hardly falls.
        """
        self.damping[which] = (self.damping[which] * self._factor(which, step, value)).clamp_min(DAMPING_MIN)

    def _factor(self, which: torch.Tensor, step: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
        """Factor on the damping after an accepted step."""
        if self.reweighted:
            return torch.full_like(value, 0.1)
        hessian = self.hessian[which] + self.neglected[which]
        curvature = (step[:, None] @ hessian @ step[..., None])[:, 0, 0]
        predicted = -(self.gradient[which] * step).sum(1) - 0.5 * curvature
        fall = self.value[which] - value
        factor = torch.where(fall >= GOOD_STEP * predicted, 0.1, 1.0)
        factor[(fall < POOR_STEP * predicted) & (predicted > ROUNDING * value)] = 10.0
        return factor

    def _descent(self, which: torch.Tensor) -> torch.Tensor:
        """Damped step with the neglected curvature, without it where that would lead uphill."""
        damping = self.damping[which]
        plain = self._free_step(which, damping)
        if self.reweighted:
            return plain
        step = self._free_step(which, damping, curved=True)
        downhill = (step * self.gradient[which]).sum(1) < 0  # False for NaN as well
        return torch.where(downhill[:, None], step, plain)

    def _free_step(
        self, which: torch.Tensor, damping: torch.Tensor, *, curved: bool = False
    ) -> torch.Tensor:
        """Damped Gauss–Newton step, with parameters that push against a bound held fixed.

        With the neglected curvature if it is to be `curved`.
        """
        pieces = zip(which.split(MEMBERS_AT_ONCE), damping.split(MEMBERS_AT_ONCE), strict=True)
        return torch.cat([self._free_step_of(*piece, curved) for piece in pieces])

    def _free_step_of(self, which: torch.Tensor, damping: torch.Tensor, curved: bool) -> torch.Tensor:
        gradient, hessian, x = self.gradient[which], self.hessian[which], self.x[which]
        neglected = self.neglected[which] if curved else 0.0
        held = ((x <= self.problem.lower) & (gradient > 0)) | ((x >= self.problem.upper) & (gradient < 0))
        free = (~held)[:, :, None] * (~held)[:, None, :]
        hessian, neglected = hessian * free + torch.diag_embed(held.double()), neglected * free
        return -_solve(hessian, gradient * ~held, damping, neglected)

    def _close(self, which: torch.Tensor, status: str) -> None:
        for member in which.tolist():
            self.status[member] = status

    def solution(self) -> Solution:
        """The batch as it stands."""
        return Solution(self.x, scaled_inverse(self.hessian), self.status, self.iterations, self.value)


def _scale(hessian: torch.Tensor) -> torch.Tensor:
    """Square root of the diagonal: parameters in units of their own curvature."""
    return torch.diagonal(hessian, dim1=1, dim2=2).clamp_min(1e-300).sqrt()


def _secant(
    neglected: torch.Tensor, hessian: torch.Tensor, step: torch.Tensor, change: torch.Tensor
) -> torch.Tensor:
    """Estimate of the neglected curvature after a `step` that changed the gradient by `change`.

    The symmetric matrix closest to the old one, in the measure of the curvature itself, that explains the
    change; the old one is sized down first if it is too large along the step.
    """
    along = (step * change).sum(1)
    unexplained = change - (hessian @ step[..., None])[..., 0]
    known = (step[:, None] @ neglected @ step[..., None])[:, 0, 0]
    size = ((step * unexplained).sum(1) / known).abs().nan_to_num(1.0).clamp_max(1.0)
    sized = size[:, None, None] * neglected
    missing = unexplained - (sized @ step[..., None])[..., 0]
    direction = change / along[:, None]
    cross = missing[:, :, None] * direction[:, None, :]
    square = (missing * step).sum(1)[:, None, None] * direction[:, :, None] * direction[:, None, :]
    usable = (along > 0) & (step != 0).any(1)
    return torch.where(usable[:, None, None], sized + cross + cross.mT - square, neglected)


def _solve(
    hessian: torch.Tensor, gradient: torch.Tensor, damping: torch.Tensor, neglected: torch.Tensor | float
) -> torch.Tensor:
    """Solve (H + neglected + damping · diag H) s = g in scaled variables."""
    scale = _scale(hessian)
    scaled = (hessian + neglected) / (scale[:, :, None] * scale[:, None, :])
    scaled = scaled + torch.diag_embed((damping + 1e-12)[:, None].expand_as(scale))
    return torch.linalg.solve_ex(scaled, (gradient / scale)[..., None])[0][..., 0] / scale


def scaled_inverse(hessian: torch.Tensor) -> torch.Tensor:
    """Inverse of a batch of Hessians, (batch, p, p), through variables scaled by their curvature.

    Directions without information get a huge variance.
    """
    return torch.cat([_scaled_inverse(some) for some in hessian.split(MEMBERS_AT_ONCE)])


def _scaled_inverse(hessian: torch.Tensor) -> torch.Tensor:
    scale = _scale(hessian)
    outer = scale[:, :, None] * scale[:, None, :]
    scaled = hessian / outer + 1e-14 * torch.eye(hessian.shape[-1], dtype=hessian.dtype)
    return torch.linalg.inv(scaled) / outer
