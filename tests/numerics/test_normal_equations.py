"""Normal equations, and where linearised fits lead.

Truth: scipy's minimiser on the written loss of the same linear problem (independent), weighted least squares
solved directly (analysis), and the sums written out in float64.
"""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases
from helpers.effect_cases import NOLLS, SPECTRUM, STRONG, WINDOW, made
from helpers.optics_cases import ncpa_nm, settings
from scipy.optimize import minimize

from irlos_pipe.diagnosis.fitting import JointFit
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.image_fit import ImageFit, Layout
from irlos_pipe.numerics.directional import Directional, along_all
from irlos_pipe.numerics.loss import L1_ROUNDING, LOSSES, normal_equations, robust_equations
from irlos_pipe.numerics.parallel import ordered_map, process_map, workers
from irlos_pipe.numerics.solver import CHI2_TOLERANCE, solve
from irlos_pipe.optics.psf import PsfModel

PARAMETERS, PIXELS = 3, 400


@pytest.fixture
def parts():
    """Derivatives, heavy-tailed whitened residuals, square roots of weights, prior precision and offset."""
    rng = np.random.default_rng(4)
    columns = torch.as_tensor(rng.standard_normal((1, PARAMETERS, PIXELS)))
    residual = torch.as_tensor(5 * rng.standard_t(3, (1, 1, PIXELS)) + 4.0 * columns[:, :1].numpy())
    root = torch.as_tensor(rng.uniform(0.5, 1.5, (1, 1, PIXELS)))
    return columns, residual, root, torch.full((1, PARAMETERS), 2.0), torch.full((1, PARAMETERS), 0.3)


def objective(parts, loss, step: np.ndarray) -> float:
    columns, residual, root, precision, offset = parts
    moved = residual[0, 0] - root[0, 0] * (torch.as_tensor(step) @ columns[0])
    prior = 0.5 * (precision[0] * (offset[0] + torch.as_tensor(step)) ** 2).sum()
    return float(loss.value(moved).sum() + prior)


def step_of(gradient: torch.Tensor, hessian: torch.Tensor) -> np.ndarray:
    return -torch.linalg.solve(hessian, gradient[..., None])[0, :, 0].numpy()


def test_of_least_squares_they_lead_where_the_equations_themselves_do(parts):
    columns, residual, root, precision, offset = parts
    gradient, hessian = robust_equations(columns, residual, root, LOSSES["gaussian"], precision, offset)
    whitened = (columns * root)[0].numpy()
    expected = whitened @ whitened.T + np.diag(precision[0])
    assert hessian[0].numpy() == pytest.approx(expected, rel=1e-12)
    slope = precision[0] * offset[0] - torch.as_tensor(whitened @ residual[0, 0].numpy())
    assert gradient[0].numpy() == pytest.approx(slope.numpy(), rel=1e-5)


@pytest.mark.parametrize("name", ["l1", "huber"])
def test_the_step_of_a_robust_loss_reaches_most_of_the_fall_that_there_is(parts, name):
    loss = LOSSES[name]
    columns, residual, root, precision, offset = parts
    found = step_of(*robust_equations(columns, residual, root, loss, precision, offset))
    best = minimize(lambda s: objective(parts, loss, s), np.zeros(PARAMETERS), method="Nelder-Mead").fun
    here = objective(parts, loss, np.zeros(PARAMETERS))
    fall = here - objective(parts, loss, found)
    assert fall > 0.9 * (here - best)


@pytest.mark.parametrize("name", ["l1", "huber"])
def test_repeated_steps_end_where_an_independent_minimiser_does(parts, name):
    loss = LOSSES[name]
    columns, residual, root, precision, offset = parts
    total = np.zeros(PARAMETERS)
    for _ in range(20):
        moved = residual - root * (torch.as_tensor(total) @ columns[0])
        offset_then = offset + torch.as_tensor(total)
        total = total + step_of(*robust_equations(columns, moved, root, loss, precision, offset_then))
    tight = {"xatol": 1e-8, "fatol": 1e-10}
    best = minimize(lambda s: objective(parts, loss, s), total + 0.1, method="Nelder-Mead", options=tight)
    assert objective(parts, loss, total) - best.fun < 0.5 * CHI2_TOLERANCE


# -- the sums ------------------------------------------------------------------------------------


def drawn_problem(parameters: int, repeats: int, own_weights: bool):
    """Derivatives, residuals and roots of weights, some pixels masked in all images and some in a few."""
    draw = torch.Generator().manual_seed(parameters + 10 * repeats)
    columns = torch.randn(3, parameters, PIXELS, generator=draw, dtype=torch.float64)
    residual = torch.randn(3, repeats, PIXELS, generator=draw, dtype=torch.float64)
    root = torch.rand(3, repeats if own_weights else 1, PIXELS, generator=draw, dtype=torch.float64)
    root[:, :, :20] = 0
    root[:, 0, 20:40] = 0
    return columns, residual * (root > 0), root


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("repeats", "own_weights"), [(1, True), (4, False), (4, True)])
@pytest.mark.parametrize("parameters", [5, 31])
def test_they_are_the_sums_over_images_and_pixels(parameters, repeats, own_weights, dtype):
    columns, residual, root = drawn_problem(parameters, repeats, own_weights)
    weight = (root**2).expand_as(residual)
    expected_slope = -torch.einsum("bpx,brx,brx->bp", columns, residual, root.expand_as(residual))
    expected_hessian = torch.einsum("bpx,brx,bqx->bpq", columns, weight, columns)
    gradient, hessian = normal_equations(columns.to(dtype), residual.to(dtype), root.to(dtype))
    rounding = PIXELS**0.5 * torch.finfo(dtype).eps * repeats
    assert gradient.dtype == hessian.dtype == torch.float64
    assert (gradient - expected_slope).abs().max() < 20 * rounding
    assert (hessian - expected_hessian).abs().max() < 20 * rounding * expected_hessian.abs().max()


# The gradient by reverse-mode differentiation.
# Truth: the gradient from Jacobians, which `test_effects_tangents` holds against finite
# differences.


# Beyond the edge of the pupil as built, where a displaced stop lets light pass, the wavefront of the images
# ends and that of the Jacobian goes on.
LEFT = {"pupil_misregistration": 2e-5}
ONE = torch.arange(1)
FLUX_E, BACKGROUND_E, NOISE_E2 = 1e6, 30.0, 100.0


def star() -> PsfModel:
    """Two colours of both bands, float64."""
    return PsfModel(
        settings(WINDOW, SPECTRUM, margin_mas=150.0, halo_margin_mas=250.0), NOLLS, dtype=torch.float64
    )


@pytest.mark.parametrize("name", sorted(STRONG.keys() - {"correlated_noise"}))
@pytest.mark.slow
def test_the_cheap_gradient_is_that_of_the_normal_equations(name):
    effect, values = made(name)
    model = ImageModel(star(), [effect])
    known = ncpa_nm(3, NOLLS[-1], 80.0)
    modes = torch.tensor([[known.get(noll, 0.0) for noll in NOLLS]], dtype=torch.float64)
    layout = Layout(NOLLS, model.effects.parameters, prior_sigma_nm=torch.full((len(NOLLS),), 200.0))
    noise = np.random.default_rng(1).normal(0, 40, (1, 1, WINDOW[0] * WINDOW[1]))
    data = ImageModel(star()).predict(modes, torch.tensor([FLUX_E]), torch.tensor([BACKGROUND_E]))
    data = data.flatten(1)[:, None] + torch.as_tensor(noise)
    problem = JointFit([ImageFit(model, layout, data, torch.full_like(data, NOISE_E2))])
    x = torch.cat([modes, values[None], torch.tensor([[1.02 * FLUX_E, BACKGROUND_E]])], dim=1)
    value, gradient, hessian = problem.normal_equations(x, ONE)
    cheap_value, cheap_gradient = problem.cheap_gradient(x, ONE)
    assert float(cheap_value) == pytest.approx(float(value), rel=1e-12)
    unit = torch.diagonal(hessian[0]).sqrt()
    slopes, cheap = (one[0] / unit for one in (gradient, cheap_gradient))
    assert cheap.numpy() == pytest.approx(slopes.numpy(), abs=LEFT.get(name, 1e-6) * float(slopes.norm()))


# Losses. Truth: automatic differentiation, the written definitions, and known estimators of location.


RESIDUALS = torch.cat([-torch.logspace(2, -3, 60), torch.logspace(-3, 2, 60)]).double()
each_loss = pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)


@each_loss
def test_the_weight_is_the_slope_over_the_residual(loss):
    r = RESIDUALS.clone().requires_grad_()
    loss.value(r).sum().backward()
    assert (loss.weight(RESIDUALS) * RESIDUALS).numpy() == pytest.approx(r.grad.numpy(), rel=1e-9)


@each_loss
def test_reweighted_least_squares_bounds_the_loss_from_above(loss):
    """The reason why re-weighting never raises the objective."""
    for at in (0.01, 0.5, 3.0, 50.0):
        here = torch.tensor([at], dtype=torch.float64)
        bound = loss.value(here) + loss.weight(here) * (RESIDUALS**2 - at**2) / 2
        assert (loss.value(RESIDUALS) <= bound + 1e-9).all()


def test_l1_is_the_absolute_value_but_for_its_rounded_kink():
    r = RESIDUALS
    assert (r.abs() - LOSSES["l1"].value(r)).numpy() == pytest.approx(
        np.full(len(r), L1_ROUNDING), abs=L1_ROUNDING
    )
    far = 2000 * L1_ROUNDING
    assert LOSSES["l1"].value(torch.tensor([far])).item() == pytest.approx(far, rel=1e-3)


def location(data: torch.Tensor, loss) -> float:
    """Position that minimises the loss, by re-weighting."""
    at = data.mean()
    for _ in range(500):
        weight = loss.weight(data - at)
        at = (weight * data).sum() / weight.sum()
    return float(at)


def test_an_outlier_pulls_the_robust_losses_least():
    data = torch.as_tensor(np.random.default_rng(4).standard_normal(200))
    hit = torch.cat([data, torch.tensor([1e4], dtype=torch.float64)])
    pull = {name: abs(location(hit, loss) - location(data, loss)) for name, loss in LOSSES.items()}
    assert pull["gaussian"] > 40
    assert pull["huber"] < 0.1 and pull["l1"] < 0.1


@pytest.mark.parametrize("scatter", [20 * L1_ROUNDING, 400 * L1_ROUNDING])
def test_the_curvature_of_l1_is_about_the_density_of_residuals_at_zero(scatter):
    """Which is √(2/π) over the standard deviation for each normal residual; 1/|r| exceeds it three times."""
    r = scatter * torch.as_tensor(np.random.default_rng(1).standard_normal((1, 1, 4000)))
    curvature = LOSSES["l1"].curvature(r).mean().item()
    assert 0.8 < curvature / (np.sqrt(2 / np.pi) / scatter) < 1.3


# Derivatives along directions, alone and from several threads at once; truth: analysis.


VALUES = torch.tensor([0.3, -1.2, 2.0], dtype=torch.float64)
FACTORS = torch.arange(1, 4, dtype=torch.float64)


def waves(values: torch.Tensor) -> torch.Tensor:
    return torch.exp(1j * FACTORS * values).sum() * torch.ones(2, dtype=torch.float64)


def slopes_of_waves(values: torch.Tensor) -> np.ndarray:
    one = 1j * FACTORS.numpy() * np.exp(1j * FACTORS.numpy() * values.numpy())
    return np.stack([one, one], axis=1)


def squares(values: torch.Tensor) -> torch.Tensor:
    return values**2


def test_derivatives_of_a_complex_function_along_all_elements():
    assert along_all(waves, VALUES).numpy() == pytest.approx(slopes_of_waves(VALUES), rel=1e-12)


def test_derivatives_by_one_element_and_along_a_direction():
    direction = torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64)
    change = Directional(squares, VALUES)
    assert change.by(1).tolist() == pytest.approx([0.0, -2.4, 0.0])
    assert change.along(direction).tolist() == pytest.approx([0.6, -4.8, 0.0])


@pytest.mark.slow
def test_threads_do_not_meet_in_their_derivatives():
    def all_of_them(scale: float) -> torch.Tensor:
        values = scale * VALUES
        single = along_all(lambda v: (v**3).sum()[None], values[:1])
        return torch.cat(
            [along_all(squares, values).sum(1), Directional(squares, values).by(0), single.flatten()]
        )

    scales = np.linspace(0.5, 2.0, 200)
    with ThreadPoolExecutor(4) as pool:
        found = torch.stack(list(pool.map(all_of_them, scales))).numpy()
    x = scales[:, None] * VALUES.numpy()
    wanted = np.column_stack([2 * x, 2 * x[:, 0], np.zeros((200, 2)), 3 * x[:, 0] ** 2])
    assert found == pytest.approx(wanted, rel=1e-12)


# Worker threads: results must not depend on them. Truth: the same calculation in one thread.


TTF = (2, 3, 4)


def fitted(count: int) -> torch.Tensor:
    model = PsfModel(cases.settings(24, cases.J_AND_H), TTF)
    mean = model.images(torch.zeros(1, 3)).double().numpy() * 1e5
    frames = cases.draw_frames(mean[0], 11, seed=1)
    images = frames[:, None].flatten(2)
    variance = cases.READ_NOISE.variance_e2(images.mean(0, keepdim=True))
    problem = ImageFit(ImageModel(model), Layout(TTF), images, variance)
    with workers(count):
        return solve(problem, problem.layout.start(images[:, 0])).values


@pytest.mark.slow
def test_fits_are_the_same_to_the_bit_for_any_number_of_workers():
    """Repeated: a worker that uses two threads inside a product differs now and then only."""
    alone = fitted(1)
    assert all(torch.equal(alone, fitted(3)) for _ in range(20))


@pytest.mark.parametrize("count", [1, 2])
def test_derivatives_by_torch_func_survive_the_workers(count):
    model = PsfModel(cases.settings(24, cases.J_AND_H), TTF, dtype=torch.float64)
    at = torch.tensor([[10.0, -20.0, 30.0]], dtype=torch.float64)
    with workers(count), torch.enable_grad():
        automatic = torch.func.jacfwd(lambda x: model.images(x)[0])(at)[:, :, 0]
        _, jacobian = model.images_and_jacobian(at)
    assert torch.allclose(automatic.permute(2, 0, 1), jacobian[0], rtol=1e-8, atol=1e-14)


def test_who_has_no_piece_left_helps_with_pieces_of_pieces():
    """Two pieces that wait for each other are within another piece, and end only where two compute them."""
    together = threading.Barrier(2)

    def piece(number: int) -> list[int]:
        return ordered_map(lambda one: together.wait(20) * 0 + one, range(2)) if number == 1 else []

    with workers(2):
        assert ordered_map(piece, range(3)) == [[], [0, 1], []]


def test_no_process_is_forked_while_threads_are_at_work():
    """A lock that another thread holds would never be released in the process."""
    forked = []

    def forked_map(function, items, report, begin, meanwhile):
        forked.append(items)
        return [function(item) for item in items]

    with workers(2, forked_map):
        ordered_map(lambda _: process_map(abs, [1, -2]), range(8))
        assert forked == []
        assert process_map(abs, [1, -2]) == [1, 2]
    assert forked == [[1, -2]]


def test_an_error_in_a_worker_reaches_the_caller():
    with workers(2), torch.no_grad(), pytest.raises(ZeroDivisionError):
        ordered_map(lambda n: 1 / n, [1, 0])
