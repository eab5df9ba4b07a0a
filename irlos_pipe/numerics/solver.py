"""Batched Levenberg–Marquardt: many independent, equally shaped least-squares problems at once.

What solvers minimise is a `Problem`, of which they know no more than is said there; its end is a `Solution`.
The solver knows no physics. A problem gives the objective, its gradient and its
Gauss–Newton Hessian for a batch of parameter vectors, in units where the objective is half
a χ². "Converged" means that the step still available would lower χ² by a negligible amount g
(`CHI2_TOLERANCE`, in units of χ²/ν where the model misfits); as g = δᵀHδ, no parameter would
move by more than √g of its standard error, 3 %. Where the iterations are used up, 10 % will do.

Where a model misfits, the curvature that Gauss–Newton neglects is not small, and convergence becomes linear.
What the gradients of successive iterations show of it is added to the Hessian of the steps (Dennis, Gay &
Welsch 1981, ACM TOMS 7, 348); whether a member has converged, and its covariance, are judged without.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import Field, dataclass, replace
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
import torch

CHI2_TOLERANCE = 1e-3  # fall of χ² that no longer matters, in units of χ²/ν where the model misfits
ROUNDING = 1e-6  # relative rounding of an objective whose images are propagated in float32


class Descent(Protocol):
    """A batch of minimisations by exact gradients; `which` selects members of the batch."""

    device: str  # where the solver works; tensors are there, and on the CPU where `solve` does

    def negligible(self, value: torch.Tensor) -> torch.Tensor:
        """Return the predicted fall of the objective at which a member with this `value` is done, (b,)."""

    def gradient(self, x: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the objective (b,) and gradient (b, p) at `x`, float64, of the members `which`."""


class Problem(ABC):
    """A batch of least-squares problems; `which` selects members of the batch."""

    lower: torch.Tensor  # bounds of the parameters, (p,) or (batch, p)
    upper: torch.Tensor
    # whether the equations are those of a re-weighted problem, whose quadratic model does not predict the
    # fall of the objective
    reweighted: bool = False
    confined: bool = False  # whether a member that reaches a bound of its parameters is lost
    same_unit: slice = slice(0)  # parameters that have the same unit, so that their curvatures compare

    @abstractmethod
    def negligible(self, value: torch.Tensor) -> torch.Tensor:
        """Return the predicted fall of twice the objective at which a member with `value` is done, (b,)."""

    @abstractmethod
    def normal_equations(
        self, x: torch.Tensor, which: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Objective (b,), gradient (b, p) and Hessian (b, p, p) at `x` of the members `which`, float64."""

    @abstractmethod
    def objective(self, x: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        """Objective (b,) at `x`, comparable with that of `normal_equations` of the same members `which`."""


class CheapGradientProblem(Problem):
    """A problem whose gradient costs a small part of its normal equations, which may have a rough one."""

    def cheap_gradient(self, x: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the objective and gradient of `normal_equations` at `x` of the members `which`: autograd."""
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            value = self.objective(x, which)
            return value.detach(), torch.autograd.grad(value.sum(), x)[0]


class _Dataclass(Protocol):
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


Batch = TypeVar("Batch", bound=_Dataclass)

CONVERGED, MAX_ITERATIONS, STALLED, INVALID = "converged", "max_iterations", "stalled", "invalid"


@dataclass(frozen=True)
class Solution:
    """Outcome of a batch of fits."""

    values: torch.Tensor  # (batch, parameters), float64
    # (batch, parameters, parameters): inverse of the Hessian at the solution (Cramér–Rao bound plus prior)
    covariance: torch.Tensor
    status: list[str]  # `converged`, `max_iterations`, `stalled` or `invalid`, one per member
    iterations: torch.Tensor  # (batch,)
    objective: torch.Tensor  # (batch,): half of χ² (prior included) at the solution

    @classmethod
    def joined(cls, parts: Sequence[Solution]) -> Solution:
        return joined(parts, status=[s for part in parts for s in part.status])

    @property
    def converged(self) -> torch.Tensor:
        """True where the fit converged, (batch,)."""
        return torch.tensor([status == CONVERGED for status in self.status])

    @property
    def sigma(self) -> torch.Tensor:
        """Standard errors, (batch, parameters)."""
        return torch.diagonal(self.covariance, dim1=1, dim2=2).clamp_min(0).sqrt()

    def updated(self, where: torch.Tensor, other: Solution, better: torch.Tensor) -> Solution:
        """Return the batch with those members of `other` that are `better`, at the positions `where`."""
        status = list(self.status)
        for member, new in zip(where.tolist(), torch.nonzero(better)[:, 0].tolist(), strict=True):
            status[member] = other.status[new]
        return mixed(self, other, where, better, status=status)


def joined(parts: Sequence[Batch], **other: Any) -> Batch:
    """Put batches of one kind one after the other: their tensors are joined, `other` fields given."""
    tensors = {name: torch.cat([getattr(part, name) for part in parts]) for name in _tensors(parts[0])}
    return replace(parts[0], **tensors, **other)


def mixed(first: Batch, second: Batch, where: torch.Tensor, better: torch.Tensor, **other: Any) -> Batch:
    """The batch `first` with the `better` members of `second` at positions `where`; `other` fields given."""
    tensors = {
        name: getattr(first, name).index_copy(0, where, getattr(second, name)[better])
        for name in _tensors(first)
    }
    return replace(first, **tensors, **other)


def _tensors(batch: _Dataclass) -> list[str]:
    return [name for name, value in vars(batch).items() if isinstance(value, torch.Tensor)]


DAMPING_START, DAMPING_MIN = 1e-3, 1e-9
MEMBERS_AT_ONCE = 256  # members whose matrices are solved at once: some ten copies of each are made
GOOD_STEP, POOR_STEP = 0.75, 0.25  # parts of the predicted fall that lower, or raise, the damping
MIN_CURVATURE = 1e-3  # curvature along a parameter over the largest of those in the same unit
LEAST_CURVATURE = 1e-186  # curvature along a parameter that nothing depends on: its variance is 1e200
TRIALS = 12  # trials of a step, with ten times the damping each
SLOW = 10.0  # times the negligible fall: where iterations are used up, a tenth of a standard error will do
SPENT = 12  # steps of a problem with cheap gradients after which its Hessian is renewed


@torch.no_grad()
def solve(
    problem: Problem,
    start: torch.Tensor,
    *,
    max_iterations: int = 50,
    report: Callable[[int], Any] = lambda count: None,
) -> Solution:
    """Minimise a batch of problems from `start`, (batch, parameters).

    `report` gets the number of members that finished in each iteration (progress bars). In the solution,
    members that meet non-finite numbers are flagged `invalid`, never silently NaN.
    """
    state = _State(problem, start.double().clone())
    for _ in range(max_iterations):
        active = state.active()
        if len(active) == 0:
            break
        report(state.iterate(active))
    state.close_slow()
    return state.solution()


class _State:
    """The batch while it is being solved; converged members are no longer evaluated.

    Its matrices are few and tiny, and NumPy starts an operation several times as quickly as PyTorch.
    """

    def __init__(self, problem: Problem, x: torch.Tensor):
        self.problem = problem
        self.lower, self.upper = (
            np.broadcast_to(one.numpy(), x.shape) for one in (problem.lower, problem.upper)
        )
        self.x = x.numpy().clip(self.lower, self.upper)
        batch, size = x.shape
        self.damping = np.full(batch, DAMPING_START)
        self.status = np.full(batch, MAX_ITERATIONS, dtype=object)
        self.iterations = np.zeros(batch, dtype=np.int64)
        self.value, self.gradient = np.full(batch, np.nan), np.zeros((batch, size))
        self.hessian = np.tile(np.eye(size), (batch, 1, 1))
        self.neglected, self.moved = np.zeros_like(self.hessian), np.zeros_like(self.gradient)
        self.reweighted = problem.reweighted
        self.cheap_gradient = problem.cheap_gradient if isinstance(problem, CheapGradientProblem) else None
        self.gain = np.full(batch, np.inf)  # the predicted fall of χ² when it was last judged
        self.age = np.zeros(batch, dtype=np.int64)  # steps since the Hessian was that of the place
        self.ahead: tuple[np.ndarray, ...] | None = None

    def active(self) -> np.ndarray:
        """Members that still move."""
        if self.problem.confined:
            lost = ((self.x <= self.lower) | (self.x >= self.upper)).any(1)
            self.status[lost & (self.status == MAX_ITERATIONS)] = INVALID
        return np.flatnonzero(self.status == MAX_ITERATIONS)

    def iterate(self, which: np.ndarray) -> int:
        """One linearisation and one accepted or refused step for every active member."""
        value, gradient, hessian = self._equations(which)
        finite = np.isfinite(value + gradient.sum(1) + hessian.sum((1, 2)))
        if not finite.all():
            self.status[which[~finite]] = INVALID
            which, value, gradient, hessian = (a[finite] for a in (which, value, gradient, hessian))
        self._learn(which, gradient, hessian)
        self.value[which], self.gradient[which], self.hessian[which] = value, gradient, hessian
        self.iterations[which] += 1
        moving = self._check_convergence(which)
        if len(moving):
            self._step(moving)
        return len(finite) - len(self.active())

    def _equations(self, which: np.ndarray) -> tuple[np.ndarray, ...]:
        """Objective, gradient and Hessian where the members are now."""
        if self.reweighted:
            return self._evaluated(self.x[which], which)
        spent = which if self.ahead is None else which[self.age[which] >= SPENT]
        if len(spent):
            self._keep(spent, self._renewed(spent))
            self.age[spent] = 0
        return tuple(array[which] for array in self.ahead or ())

    def _renewed(self, which: np.ndarray) -> tuple[np.ndarray, ...]:
        """Equations with the Hessian of the place; a gradient by itself is exact, where theirs may be rough.

        A rough one predicts falls that do not come, and the iterations go round in circles.
        """
        x = self.x[which]
        value, gradient, hessian = self._evaluated(x, which)
        if self.ahead is not None:
            value, gradient = (array[which] for array in self.ahead[:2])
        elif self.cheap_gradient is not None:
            value, gradient = self._slope(x, which)
        return value, gradient, hessian

    def _slope(self, x: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, ...]:
        """Objective and gradient, exact."""
        assert self.cheap_gradient is not None
        return tuple(tensor.numpy() for tensor in self.cheap_gradient(*map(torch.from_numpy, (x, which))))

    def _evaluated(self, x: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, ...]:
        equations = self.problem.normal_equations(torch.from_numpy(x), torch.from_numpy(which))
        return tuple(tensor.numpy() for tensor in equations)

    def _keep(self, which: np.ndarray, equations: tuple[np.ndarray, ...]) -> None:
        """Equations of some members, for their next iteration."""
        if self.ahead is None:
            self.ahead = self.value.copy(), self.gradient.copy(), self.hessian.copy()
        for array, new in zip(self.ahead, equations, strict=True):
            array[which] = new

    def _learn(self, which: np.ndarray, gradient: np.ndarray, hessian: np.ndarray) -> None:
        """Update the neglected curvature of members that have moved."""
        moved = self.moved[which]
        if not self.reweighted and moved.any():
            change = gradient - self.gradient[which]
            self.neglected[which] = _secant(self.neglected[which], hessian, moved, change)
            self.moved[which] = 0.0

    def _check_convergence(self, which: np.ndarray) -> np.ndarray:
        """Close members whose undamped step is negligible; return those that should step.

        Those whose Hessian is of another place are asked again with a new one.
        """
        step = self._free_step(which, np.zeros(len(which)))
        gain = -(self.gradient[which] * step).sum(1)  # twice the predicted decrease of the objective
        value = self.value[which]
        negligible = self.problem.negligible(torch.from_numpy(value)).numpy()
        small = gain < np.maximum(negligible, ROUNDING * value)
        self.gain[which] = gain
        aged = self.age[which] > 0
        self.age[which[small & aged]] = SPENT
        if (small & ~aged).any():
            self._finish(which[small & ~aged])
        return which[~small]

    def close_slow(self) -> None:
        """Members that have used up their iterations and hardly fall: along a ridge, no end comes soon."""
        which = self.active()
        if len(which):
            negligible = self.problem.negligible(torch.from_numpy(self.value[which])).numpy()
            self.status[which[self.gain[which] < SLOW * negligible]] = CONVERGED

    def _finish(self, which: np.ndarray) -> None:
        """Close members, with the step that was found negligible, which is there anyway.

        Damping keeps it from leaping along a direction that the data do not determine. Where it leads costs
        an evaluation, and is looked at only if the Hessian may be a rough one, which can miss a rise there.
        """
        self.status[which] = CONVERGED
        if self.reweighted:
            return
        step = self._free_step(which, self.damping[which].clip(min=DAMPING_START))
        ended = self._within(self.x[which] + step, which)
        if self.cheap_gradient is not None:
            value = self.problem.objective(torch.from_numpy(ended), torch.from_numpy(which)).numpy()
            no_worse = value <= self.value[which] * (1 + ROUNDING)  # False for NaN as well
            which, ended = which[no_worse], ended[no_worse]
        self.x[which] = ended

    def _within(self, x: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Parameters of some members within their bounds."""
        return x.clip(self.lower[which], self.upper[which])

    def _step(self, which: np.ndarray) -> None:
        """Try damped steps, raising the damping until the objective falls."""
        for _ in range(TRIALS):
            trial = self._within(self.x[which] + self._descent(which), which)
            tried = self._tried(trial, which)
            value = tried[0]
            better = value <= self.value[which] * (1 + ROUNDING)  # False for NaN as well
            taken, trial = which[better], trial[better]
            if len(tried) > 1:
                self._keep(taken, tuple(array[better] for array in tried))
            self.moved[taken] = trial - self.x[taken]
            self.x[taken] = trial
            factor = self._factor(taken, value[better])
            self.damping[taken] = (self.damping[taken] * factor).clip(min=DAMPING_MIN)
            self.value[taken] = value[better]
            if self.cheap_gradient is not None:  # a Hessian is kept, unless a step was not the first and poor
                self.age[taken] += 1
                self.age[taken[(factor > 1) & (self.age[taken] > 1)]] = SPENT
            which = which[~better]
            aged = self.age[which] > 0  # these refuse a step because their Hessian is of another place
            self.age[which[aged]] = SPENT
            which = which[~aged]
            if len(which) == 0:
                return
            self.damping[which] *= 10
        self.status[which] = STALLED

    def _tried(self, x: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, ...]:
        """Objective of trial steps, and the equations there for the next iteration.

        Steps are seldom refused, and images cost a part of what their derivatives do: those are evaluated
        with them, except where equations are not those of the objective.
        """
        if self.reweighted:
            return (self.problem.objective(torch.from_numpy(x), torch.from_numpy(which)).numpy(),)
        if self.cheap_gradient is None:
            return self._evaluated(x, which)
        return *self._slope(x, which), self.hessian[which]

    def _factor(self, which: np.ndarray, value: np.ndarray) -> np.ndarray:
        """Factor on the damping after an accepted step that led to `value`.

        Lower where the quadratic model predicted the fall, raise where it did not: in a noisy image the
        curvature that Gauss–Newton neglects can be as large as what it keeps. Full steps then leap across
        the minimum and back, and the objective hardly falls.
        """
        if self.reweighted:
            return np.full(len(which), 0.1)
        step = self.moved[which]
        bent = ((self.hessian[which] + self.neglected[which]) @ step[..., None])[..., 0]
        predicted = -((self.gradient[which] + 0.5 * bent) * step).sum(1)
        fall = self.value[which] - value
        poor = (fall < POOR_STEP * predicted) & (predicted > ROUNDING * value)
        return np.where(poor, 10.0, np.where(fall >= GOOD_STEP * predicted, 0.1, 1.0))

    def _descent(self, which: np.ndarray) -> np.ndarray:
        """Damped step with the neglected curvature, without it where that would lead uphill."""
        damping = self.damping[which]
        if self.reweighted:
            return self._free_step(which, damping)
        step = self._free_step(which, damping, self.neglected[which])
        downhill = (step * self.gradient[which]).sum(1) < 0  # False for NaN as well
        if downhill.all():
            return step
        return np.where(downhill[:, None], step, self._free_step(which, damping))

    def _free_step(
        self, which: np.ndarray, damping: np.ndarray, neglected: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """Damped Gauss–Newton step; parameters that push against a bound, or have no curvature, are held.

        A Hessian of another place may know nothing of a parameter that has got a slope since.
        """
        x, gradient, hessian = self.x[which], self.gradient[which], self.hessian[which]
        held = (x <= self.lower[which]) & (gradient > 0) | (x >= self.upper[which]) & (gradient < 0)
        held |= np.diagonal(hessian, axis1=1, axis2=2) <= 0
        if held.any():
            free = ~held[:, :, None] & ~held[:, None, :]
            hessian = hessian * free + held[:, :, None] * np.eye(held.shape[1])
            gradient, neglected = gradient * ~held, neglected * free
        return -_solve(hessian, gradient, damping, neglected, self.problem.same_unit)

    def solution(self) -> Solution:
        x, hessian, iterations, value = map(
            torch.from_numpy, (self.x, self.hessian, self.iterations, self.value)
        )
        return Solution(x, scaled_inverse(hessian), self.status.tolist(), iterations, value)


def _secant(neglected: np.ndarray, hessian: np.ndarray, step: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Estimate of the neglected curvature after a `step` that changed the gradient by `change`.

    The symmetric matrix closest to the old one, in the measure of the curvature itself, that explains the
    change; the old one is sized down first if it is too large along the step.
    """
    step, change = step[..., None], change[..., None]
    unexplained, explained = change - hessian @ step, neglected @ step
    along, known, required = ((step * v).sum((1, 2), keepdims=True) for v in (change, explained, unexplained))
    with np.errstate(divide="ignore", invalid="ignore"):
        size = np.nan_to_num(np.abs(required / known), nan=1.0).clip(max=1.0)
        direction = change / along
        cross = (unexplained - size * explained) * direction.swapaxes(1, 2)
        square = (required - size * known) * direction * direction.swapaxes(1, 2)
        found = size * neglected + cross + cross.swapaxes(1, 2) - square
    return np.where(along > 0, found, neglected)


def _solve(
    hessian: np.ndarray,
    gradient: np.ndarray,
    damping: np.ndarray,
    neglected: np.ndarray | float,
    same_unit: slice,
) -> np.ndarray:
    """Solve (H + neglected + damping · D) s = g in scaled variables; D is diag H, where that is no rounding.

    Without a diversity an image in focus does not show even modes: their slope vanishes, and rounding of
    it would make steps of any length.
    """
    diagonal = np.diagonal(hessian, axis1=1, axis2=2).clip(min=1e-300)
    compared = diagonal[:, same_unit]
    diagonal[:, same_unit] = compared.clip(min=MIN_CURVATURE * compared.max(1, initial=0, keepdims=True))
    scale = np.sqrt(diagonal)
    scaled = (hessian + neglected) / (scale[:, :, None] * scale[:, None, :])
    scaled += (damping + 1e-12)[:, None, None] * np.eye(scale.shape[1])
    return np.linalg.solve(scaled, (gradient / scale)[..., None])[..., 0] / scale


def scaled_inverse(hessian: torch.Tensor) -> torch.Tensor:
    """Return the inverse of a batch of Hessians, (batch, p, p), through variables scaled by their curvature.

    Directions without information get a huge variance, which is finite: what does not depend on them has
    errors all the same.
    """
    pieces = [torch.from_numpy(_scaled_inverse(some.numpy())) for some in hessian.split(MEMBERS_AT_ONCE)]
    return pieces[0] if len(pieces) == 1 else torch.cat(pieces)


def _scaled_inverse(hessian: np.ndarray) -> np.ndarray:
    scale = np.sqrt(np.diagonal(hessian, axis1=1, axis2=2).clip(min=LEAST_CURVATURE))
    outer = scale[:, :, None] * scale[:, None, :]
    return np.linalg.inv(hessian / outer + 1e-14 * np.eye(hessian.shape[-1])) / outer
