"""Minimisation by gradients and learnt curvature.

Truth: scipy's minimiser on the same functions (independent), and the minimum of a quadratic (analysis).
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import minimize, rosen, rosen_der

from irlos_pipe.numerics.parallel import workers
from irlos_pipe.numerics.problem import ROUNDING
from irlos_pipe.numerics.quasi_newton import FRAMES_PER_PIECE, polish
from irlos_pipe.numerics.solution import CONVERGED, INVALID, MAX_ITERATIONS, STALLED, Solution

SIZE = 4


class Functions:
    """A batch of functions of `SIZE` variables, from one of NumPy and its gradient."""

    def __init__(self, function, slope):
        self.function, self.slope = function, slope

    def negligible(self, value):
        return torch.full_like(value, 1e-12)

    def gradient(self, x, which):
        members = list(zip(x.numpy(), which.tolist(), strict=True))
        parts = [[of(v, m) for v, m in members] for of in (self.function, self.slope)]
        return tuple(torch.as_tensor(np.array(part)) for part in parts)


VALLEYS = Functions(lambda x, _: 1.0 + rosen(x), lambda x, _: rosen_der(x))


def started(x: np.ndarray, variance: float = 1e-3) -> Solution:
    count = len(x)
    covariance = variance * torch.eye(SIZE, dtype=torch.float64).repeat(count, 1, 1)
    iterations, unknown = torch.zeros(count, dtype=torch.int64), torch.zeros(count, dtype=torch.float64)
    return Solution(torch.as_tensor(x), covariance, [MAX_ITERATIONS] * count, iterations, unknown)


def starts(count: int) -> np.ndarray:
    return np.random.default_rng(1).uniform(-1.5, 1.5, (count, SIZE))


def test_every_member_reaches_a_minimum_of_a_curved_valley():
    found = polish(VALLEYS, started(starts(6)), 300)
    assert found.status == [CONVERGED] * 6
    lowest = [1.0 + minimize(rosen, x, jac=rosen_der, method="BFGS").fun for x in found.values.numpy()]
    assert found.objective.numpy() == pytest.approx(lowest, rel=10 * ROUNDING)


def test_a_quadratic_with_its_own_hessian_takes_one_step():
    centre = np.arange(3 * SIZE, dtype=float).reshape(3, SIZE)
    bowls = Functions(lambda x, m: 500.0 * np.sum((x - centre[m]) ** 2), lambda x, m: 1e3 * (x - centre[m]))
    found = polish(bowls, started(np.zeros((3, SIZE))), 10)
    assert found.values.numpy() == pytest.approx(centre, abs=1e-9)
    assert found.iterations.tolist() == [2, 2, 2]  # where it starts, and where the step leads


@pytest.mark.slow
def test_members_do_not_see_each_other():
    """Those of one piece, of different pieces, and in different threads."""
    many = starts(2 * FRAMES_PER_PIECE + 3)
    together = polish(VALLEYS, started(many), 40)
    some = [0, FRAMES_PER_PIECE, len(many) - 1]
    alone = [polish(VALLEYS, started(many[i : i + 1]), 40).values[0] for i in some]
    assert torch.stack(alone).numpy() == pytest.approx(together.values[some].numpy())
    with workers(2):
        assert torch.equal(polish(VALLEYS, started(many), 40).values, together.values)


def test_an_objective_that_is_not_finite_is_invalid():
    wild = Functions(lambda x, m: np.nan if m else 1 + rosen(x), lambda x, _: rosen_der(x))
    assert polish(wild, started(starts(2)), 300).status == [CONVERGED, INVALID]


def test_a_slope_that_no_step_confirms_is_stalled():
    lying = Functions(lambda x, _: float(np.sum(x**2)), lambda x, _: -2 * x)
    assert polish(lying, started(starts(2)), 300).status == [STALLED, STALLED]
