"""Fits of all frames of a cube, which are much alike: what they share is computed once.

The curvature at a few frames serves all others, and what it misses is learnt from the gradients along the way
(`quasi_newton`). Plain least squares come first, as their curvature hardly changes. Only frames that are not
done then get a linearisation of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.numerics.levenberg_marquardt import scaled_inverse, solve
from irlos_pipe.numerics.loss import GAUSSIAN
from irlos_pipe.numerics.quasi_newton import polish
from irlos_pipe.numerics.solution import CONVERGED, INVALID, MAX_ITERATIONS, Solution

FEW = 10  # frames whose mean curvature stands for that of all
LEAST_SQUARES_EVALUATIONS = 4
EVALUATIONS = 50  # most frames are done by then


@torch.no_grad()
def fit_frames(
    problem: ImageFit,
    start: torch.Tensor,
    *,
    max_iterations: int,
    report: Callable[[int], None] | None = None,
) -> Solution:
    """Minimise a batch of fits of single frames without bounds.

    Parameters
    ----------
    problem : ImageFit
    start : tensor, (frames, parameters)
    max_iterations : int
        Evaluations of a frame after the first linearisation of its own, at most.
    report : callable, optional
        Called with the number of frames that were finished.

    Returns
    -------
    Solution
        `iterations` counts evaluations; `covariance` is the mean of a few frames' for those that never had
        a linearisation of their own.
    """
    squares = problem.with_loss(replace(GAUSSIAN, whitened=problem.loss.whitened))
    found = polish(squares, _with_shared_curvature(squares, start), LEAST_SQUARES_EVALUATIONS)
    shared = _with_shared_curvature(problem, found.values)
    found = polish(problem, replace(shared, iterations=found.iterations), EVALUATIONS)
    open_before = len(start)
    for spent in range(0, max_iterations, EVALUATIONS):
        left = _unfinished(found)
        if report is not None:
            report(open_before - len(left))
        if len(left) == 0:
            return found
        more = min(EVALUATIONS, max_iterations - spent)
        found, open_before = _by_themselves(problem, found, left, more), len(left)
    if report is not None:
        report(open_before)
    return found


def _by_themselves(problem: ImageFit, found: Solution, which: torch.Tensor, evaluations: int) -> Solution:
    """Some members continued, each from a linearisation of its own."""
    some = problem.members(which)
    near = solve(some, found.values[which], max_iterations=1)
    better = polish(some, near, evaluations)
    better = replace(better, iterations=found.iterations[which] + better.iterations)
    return found.updated(which, better, torch.ones(len(which), dtype=torch.bool))


def _with_shared_curvature(problem: ImageFit, x: torch.Tensor) -> Solution:
    """These parameters with the inverse of the mean Hessian of a few members."""
    few = torch.linspace(0, len(x) - 1, min(FEW, len(x))).round().long()
    _, _, hessian = problem.normal_equations(x[few], few)
    hessian = hessian[torch.isfinite(hessian).all((1, 2))].mean(0, keepdim=True)
    covariance = scaled_inverse(hessian).expand(len(x), -1, -1)
    unknown = torch.full((len(x),), float("nan"), dtype=torch.float64)
    return Solution(x, covariance, [MAX_ITERATIONS] * len(x), torch.zeros(len(x), dtype=torch.int64), unknown)


def _unfinished(found: Solution) -> torch.Tensor:
    """Members that can be improved, those that are stuck included."""
    return torch.tensor([i for i, s in enumerate(found.status) if s not in (CONVERGED, INVALID)]).long()
