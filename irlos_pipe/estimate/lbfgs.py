"""L-BFGS with automatic differentiation: the paper's optimiser, kept as the slow twin of `solve`.

All members of the batch are one big problem, as in "DIP global".
"""

from __future__ import annotations

import torch

from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.numerics.levenberg_marquardt import scaled_inverse
from irlos_pipe.numerics.solution import CONVERGED, INVALID, MAX_ITERATIONS, Solution

HISTORY = 20
GRADIENT_TOLERANCE = 1e-2  # in units of one standard error


def solve_lbfgs(problem: ImageFit, start: torch.Tensor, *, max_iterations: int = 300) -> Solution:
    """Minimise the sum of all members' objectives with PyTorch's L-BFGS (strong Wolfe line search).

    The variables are scaled by the curvature at the start, so that nm, electrons and
    variances are of one size.

    Parameters
    ----------
    problem : ImageFit
    start : tensor, (batch, parameters)
    max_iterations : int
    """
    everyone = torch.arange(len(start))
    _, _, hessian = problem.normal_equations(start, everyone)
    scale = torch.diagonal(hessian, dim1=1, dim2=2).clamp_min(1e-300).rsqrt()
    u = torch.zeros_like(start, requires_grad=True)
    optimiser = torch.optim.LBFGS(
        [u],
        max_iter=max_iterations,
        history_size=HISTORY,
        line_search_fn="strong_wolfe",
        tolerance_grad=GRADIENT_TOLERANCE,
        tolerance_change=1e-12,
    )

    def closure() -> torch.Tensor:
        optimiser.zero_grad()
        total = problem.objective(start + scale * u, everyone).sum()
        total.backward()
        return total

    optimiser.step(closure)
    x = (start + scale * u.detach()).clamp(problem.lower, problem.upper)
    evaluations = optimiser.state[u]["n_iter"]
    value, gradient, hessian = problem.normal_equations(x, everyone)
    small = (gradient.abs() * scale).amax(1) < 10 * GRADIENT_TOLERANCE * (2 * value).clamp_min(1).sqrt()
    finite = torch.isfinite(value)
    outcome = zip(small, finite, strict=True)
    status = [CONVERGED if s and f else MAX_ITERATIONS if f else INVALID for s, f in outcome]
    return Solution(x, scaled_inverse(hessian), status, torch.full((len(start),), evaluations), value)
