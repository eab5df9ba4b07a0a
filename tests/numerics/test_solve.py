"""The batched solver. Truth: scipy.optimize.least_squares on the same problems, and analysis."""

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares, minimize, rosen, rosen_der

from irlos_pipe.numerics.parallel import workers
from irlos_pipe.numerics.quasi_newton import FRAMES_PER_PIECE, polish
from irlos_pipe.numerics.solver import (
    CONVERGED,
    INVALID,
    MAX_ITERATIONS,
    ROUNDING,
    STALLED,
    CheapGradientProblem,
    Problem,
    Solution,
    scaled_inverse,
    solve,
)

X = np.linspace(0, 4, 40)


class Decays(Problem):
    """Curves ``a exp(-b x) + c`` with unit noise, one per member, for the solver."""

    def __init__(self, data, lower=-np.inf, upper=np.inf):
        self.data = torch.as_tensor(data)
        self.lower = torch.full((3,), lower, dtype=torch.float64)
        self.upper = torch.full((3,), upper, dtype=torch.float64)

    def negligible(self, value):
        return torch.full_like(value, 1e-6)

    def _parts(self, p):
        x = torch.as_tensor(X)
        decay = torch.exp(-p[:, 1:2] * x)
        columns = torch.stack([decay, -p[:, :1] * x * decay, torch.ones_like(decay)], dim=1)
        return p[:, :1] * decay + p[:, 2:], columns

    def objective(self, p, which):
        return 0.5 * ((self.data[which] - self._parts(p)[0]) ** 2).sum(1)

    def normal_equations(self, p, which):
        model, columns = self._parts(p)
        residual = self.data[which] - model
        value = 0.5 * (residual**2).sum(1)
        return value, -(columns @ residual[..., None])[..., 0], columns @ columns.mT


class Frugal(Decays, CheapGradientProblem):
    """The same with a cheap gradient."""

    def cheap_gradient(self, p, which):
        return Decays.normal_equations(self, p, which)[:2]


class Rough(Frugal):
    """The same with derivatives that are 1 % off wherever they make the normal equations."""

    def normal_equations(self, p, which):
        model, columns = self._parts(p)
        residual = self.data[which] - model
        columns = columns * (1 + 0.01 * torch.cos(3 * torch.as_tensor(X)))
        return 0.5 * (residual**2).sum(1), -(columns @ residual[..., None])[..., 0], columns @ columns.mT


def curves(seed: int = 3, members: int = 5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(50, 200, members), rng.uniform(0.3, 2, members)
    return a[:, None] * np.exp(-b[:, None] * X) + 7 + rng.standard_normal((members, len(X)))


def start(members: int) -> torch.Tensor:
    return torch.tensor([[80.0, 1.0, 0.0]], dtype=torch.float64).repeat(members, 1)


def scipy_fit(curve: np.ndarray, bounds=(-np.inf, np.inf)):
    def residual(p):
        return p[0] * np.exp(-p[1] * X) + p[2] - curve

    return least_squares(residual, [80, 1, 0.0], bounds=bounds, x_scale="jac")


@pytest.mark.parametrize("kind", [Decays, Frugal, Rough])
@pytest.mark.parametrize("members", [5, 8])
def test_every_member_of_a_batch_reaches_the_minimum_that_scipy_finds(kind, members):
    data = curves(members=members)
    solution = solve(kind(data), start(len(data)))
    expected = np.array([scipy_fit(curve).x for curve in data])
    assert solution.status == [CONVERGED] * len(data)
    assert np.abs(solution.values.numpy() - expected).max() < 2e-3 * solution.sigma.numpy().max()


@pytest.mark.parametrize("kind", [Decays, Frugal])
def test_the_covariance_is_the_inverse_of_the_fisher_matrix(kind):
    data = curves(members=1)
    solution = solve(kind(data), start(1))
    jacobian = scipy_fit(data[0]).jac
    assert np.allclose(solution.covariance[0], np.linalg.inv(jacobian.T @ jacobian), rtol=1e-3)


def test_a_parameter_stays_at_the_bound_that_holds_it():
    data = curves(members=1)
    solution = solve(Decays(data, lower=0.0, upper=90.0), start(1))
    expected = scipy_fit(data[0], bounds=(0.0, 90.0)).x
    assert solution.status == [CONVERGED]
    assert np.allclose(solution.values[0], expected, rtol=1e-3)


def test_a_member_with_nan_is_flagged_and_leaves_the_others_alone():
    data = curves()
    broken = data.copy()
    broken[2, 5] = np.nan
    solution = solve(Decays(broken), start(len(data)))
    clean = solve(Decays(data), start(len(data)))
    good = [0, 1, 3, 4]
    assert solution.status[2] == INVALID
    assert torch.equal(solution.values[good], clean.values[good])


def test_where_iterations_are_used_up_a_tenth_of_a_standard_error_will_do():
    """Parabolas at 0.05 and 0.5 standard errors from their minimum, with one iteration."""
    start = torch.tensor([[0.05], [0.5]], dtype=torch.float64)
    assert solve(Bent(0.0), start, max_iterations=1).status == [CONVERGED, MAX_ITERATIONS]


class Bent(Problem):
    """Residuals ``x``, ``1 + bend x²/2`` and a large constant, as noise makes it.

    At the minimum, x = 0, Gauss–Newton sees a curvature of 1, and there is one of 1 + bend: above
    a bend of 1 its full steps leap further across the minimum every time.
    """

    lower, upper = torch.tensor([-9.0]), torch.tensor([9.0])
    constant = 2000.0

    def __init__(self, bend: float):
        self.bend = bend

    def negligible(self, value):
        return torch.full_like(value, 1e-3)

    def objective(self, p, which):
        x = p[:, 0]
        return 0.5 * (x**2 + (1 + 0.5 * self.bend * x**2) ** 2) + self.constant

    def normal_equations(self, p, which):
        slope = self.bend * p
        gradient = p + (1 + 0.5 * self.bend * p**2) * slope
        return self.objective(p, which), gradient, (1 + slope**2)[..., None]


@pytest.mark.parametrize(("bend", "steps"), [(-0.7, 6), (0.0, 6), (0.9, 6), (1.3, 6), (2.0, 40)])
def test_the_curvature_that_gauss_newton_neglects_is_learnt_from_the_gradients(bend, steps):
    """Plain Gauss–Newton steps change the distance to the minimum only by the factor |bend|."""
    solution = solve(Bent(bend), torch.tensor([[0.2]]), max_iterations=40)
    assert solution.status == [CONVERGED]
    assert abs(float(solution.values)) < 0.05 or bend < 0
    assert int(solution.iterations[0]) <= steps


def test_a_start_where_nothing_can_be_learnt_of_a_parameter_is_not_left_in_a_leap():
    """Analysis: the slope of cos(x) vanishes at 0, and rounding of it must not send x anywhere."""

    class Blind(Problem):
        lower, upper = torch.full((2,), -torch.inf), torch.full((2,), torch.inf)
        same_unit = slice(0, 2)

        def negligible(self, value):
            return torch.full_like(value, 1e-3)

        def objective(self, x, which):
            return 0.5 * ((x[:, 0] - 1.0) ** 2 + (torch.cos(x[:, 1]) - 0.9) ** 2)

        def normal_equations(self, x, which):
            slope = -torch.sin(x[:, 1]) + 1e-18
            gradient = torch.stack([x[:, 0] - 1.0, (torch.cos(x[:, 1]) - 0.9) * slope], 1)
            hessian = torch.diag_embed(torch.stack([torch.ones(len(x)).double(), slope**2], 1))
            return self.objective(x, which), gradient, hessian

    found = solve(Blind(), torch.tensor([[0.3, 0.0]], dtype=torch.float64))
    assert float(found.values[0, 0]) == pytest.approx(1.0, abs=1e-3)
    assert abs(float(found.values[0, 1])) < 10


def test_what_does_not_depend_on_a_dead_parameter_has_its_error():
    # Truth: the inverse without the row and column of the dead parameter, the second of four.
    alive, root = [0, 2, 3], np.random.default_rng(4).standard_normal((3, 3))
    hessian = np.zeros((1, 4, 4))
    hessian[0][np.ix_(alive, alive)] = root @ root.T + np.eye(3)
    inverse = scaled_inverse(torch.from_numpy(hessian))[0].numpy()
    assert np.isfinite(inverse).all()
    assert inverse[1, 1] > 1e100
    assert inverse[np.ix_(alive, alive)] == pytest.approx(np.linalg.inv(hessian[0][np.ix_(alive, alive)]))
    assert np.all(np.isfinite(inverse @ hessian[0]))


# Minimisation by gradients and learnt curvature.
# Truth: scipy's minimiser on the same functions (independent), and the minimum of a quadratic (analysis).


SIZE = 4


class Functions:
    """A batch of functions of `SIZE` variables, from one of NumPy and its gradient."""

    device = "cpu"

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
