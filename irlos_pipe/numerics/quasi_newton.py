"""Many small minimisations by exact gradients and learnt curvature (BFGS).

A gradient costs as much as two images, a Jacobian as much as ten gradients. Where some Hessian is known that
roughly holds, steps by gradients alone are therefore cheaper (Nocedal & Wright 2006, Numerical Optimization,
ch. 6). Members are independent of each other; parameters have no bounds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from irlos_pipe.numerics.parallel import at_once, process_map
from irlos_pipe.numerics.solver import (
    CONVERGED,
    INVALID,
    MAX_ITERATIONS,
    ROUNDING,
    STALLED,
    Descent,
    Solution,
)

FRAMES_PER_PIECE = 32
ENOUGH = 1e-4  # part of the fall promised by the slope that a step must deliver (Armijo)
SHORTEST = 1e-3  # part of a step below which a member is stuck
SHORTER = (0.1, 0.5)  # factors on the length of a step that went too far


@torch.no_grad()
def polish(problem: Descent, found: Solution, max_evaluations: int) -> Solution:
    """Continue from a solution by at most `max_evaluations` gradients of every member.

    The covariance of `found` is the inverse Hessian to begin with, and that of the result; evaluations are
    counted as iterations. Members that were `invalid` are left as they are; others can be `stalled`, or out
    of evaluations (`max_iterations`).
    """
    members = torch.tensor([i for i, status in enumerate(found.status) if status != INVALID]).long()
    pieces = members.split(at_once(FRAMES_PER_PIECE, problem.device))
    polished = process_map(lambda which: _polished(problem, found, which, max_evaluations), pieces)
    x, value, evaluations, states = (
        torch.from_numpy(np.concatenate(part)) for part in zip(*polished, strict=True)
    )
    values, objective, iterations = (t.clone() for t in (found.values, found.objective, found.iterations))
    values[members], objective[members] = x, value
    iterations[members] += evaluations
    status = list(found.status)
    for member, state in zip(members.tolist(), states.tolist(), strict=True):
        status[member] = STATES[state]
    return replace(found, values=values, objective=objective, iterations=iterations, status=status)


def _polished(problem: Descent, found: Solution, which: torch.Tensor, max_evaluations: int) -> tuple:
    """Parameters, objective, evaluations and number of the status of some members, as arrays of NumPy."""
    start = found.values[which], found.covariance[which], which
    descent = _Descent(problem, *(one.to(problem.device) for one in start))
    moving = descent.moving()
    for _ in range(1, max_evaluations):
        if len(moving) == 0:
            break
        descent.step(moving)
        moving = descent.moving()
    return tuple(one.cpu().numpy() for one in (descent.x, descent.value, descent.evaluations, descent.state))


MOVING = MAX_ITERATIONS
STATES = MOVING, CONVERGED, STALLED, INVALID


class _Descent:
    """Some members while they are minimised, on the device of the problem."""

    def __init__(self, problem: Descent, x: torch.Tensor, inverse: torch.Tensor, which: torch.Tensor):
        self.problem, self.which, self.x, self.inverse = problem, which, x, inverse
        self.value, self.gradient = problem.gradient(x, which)
        self.evaluations = torch.ones_like(which)
        self.fraction = torch.ones_like(self.value)
        self.state = torch.zeros_like(which)
        self._close(~(torch.isfinite(self.value) & torch.isfinite(self.gradient).all(1)), INVALID)

    def moving(self) -> torch.Tensor:
        """Members that have some way to go; the others are closed."""
        self.ahead = -(self.inverse @ self.gradient[..., None])[..., 0]
        fall = -0.5 * (self.gradient * self.ahead).sum(1)
        negligible = torch.maximum(self.problem.negligible(self.value), ROUNDING * self.value)
        self._close(fall < negligible, CONVERGED)
        self._close(self.fraction < SHORTEST, STALLED)
        return (self.state == STATES.index(MOVING)).nonzero()[:, 0]

    def _close(self, members: torch.Tensor, status: str) -> None:
        """Give these members a final status, unless they have one."""
        closing = members & (self.state == STATES.index(MOVING))
        self.state.masked_fill_(closing, STATES.index(status))

    def step(self, moving: torch.Tensor) -> None:
        """Try a step of every moving member; take it where the objective falls, else shorten it."""
        step = self.fraction[moving, None] * self.ahead[moving]
        trial = self.x[moving] + step
        value, gradient = self.problem.gradient(trial, self.which[moving])
        self.evaluations[moving] += 1
        slope, rise = (self.gradient[moving] * step).sum(1), value - self.value[moving]
        better = rise <= ENOUGH * slope  # False for NaN as well
        taken = moving[better]
        self._learn(taken, step[better], (gradient - self.gradient[moving])[better])
        self.x[taken], self.value[taken] = trial[better], value[better]
        self.gradient[taken] = gradient[better]
        shorter = (-0.5 * slope / (rise - slope)).nan_to_num(0.0).clamp(*SHORTER)
        self.fraction[moving] = torch.where(better, 1.0, self.fraction[moving] * shorter)

    def _learn(self, moving: torch.Tensor, step: torch.Tensor, change: torch.Tensor) -> None:
        """Let the inverse Hessian explain what a step changed in the gradient, where it stays positive."""
        along = (step * change).sum(1)
        expected = (self.inverse[moving] @ change[..., None])[..., 0]
        part = 0.5 * (1 + (change * expected).sum(1) / along)
        other = (part[:, None] * step - expected) / along[:, None]
        usable = (along > 0) & torch.isfinite(other).all(1)
        step, other = (torch.where(usable[:, None], v, 0.0) for v in (step, other))
        left, right = torch.stack([step, other], dim=2), torch.stack([other, step], dim=1)
        self.inverse[moving] += left @ right
