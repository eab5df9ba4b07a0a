"""LIFT on images drawn from the model. Truth: Monte Carlo (the images come from the same model, on
purpose: bias, efficiency and error bars are properties of the estimator), analysis at zero flux, and fits
with derivatives of their own."""

from functools import partial

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases
from helpers.light_path_derivatives import assert_gradient
from helpers.optics_cases import J_AND_H, halo_and_jitter, ncpa_nm, settings, vector
from scipy.optimize import minimize

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration_options import LiftOptions
from irlos_pipe.estimate.image_fit import ImageFit, Layout
from irlos_pipe.estimate.lift import REACH_NM, PhotonFit, image_problem, lift, near
from irlos_pipe.estimate.methods import fit_frames
from irlos_pipe.estimate.ramp_fit import RampData, fit_ramp, start_from_defocus
from irlos_pipe.estimate.sensitivity import cramer_rao_nm
from irlos_pipe.estimate.starts import scan_start_nm
from irlos_pipe.files.processes import forked_map
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics import quasi_newton
from irlos_pipe.numerics.loss import LOSSES
from irlos_pipe.numerics.parallel import workers
from irlos_pipe.numerics.solver import CONVERGED
from irlos_pipe.optics.fourier_matrices import MAS
from irlos_pipe.optics.psf import PsfModel

TWO_COLOURS = ((1215.0, 1.0), (1625.0, 1.0))
TTF = (2, 3, 4)
NOISE = NoiseModel(1.0, 6.0)  # 1 e- of read noise and a background of 5 e- per pixel


@pytest.fixture(scope="module")
def model() -> PsfModel:
    return PsfModel(cases.settings(40, TWO_COLOURS), TTF)


def drawn(model, coefficients, flux_e, seed, noise=NOISE):
    """Images of the model with noise, float32."""
    mean_e = (model.images(coefficients).double() * flux_e).clamp_min(0).numpy()
    return cases.draw_frames(mean_e, len(mean_e), seed, noise)


def random_modes(images: int, seed: int) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    tilts = 40 * rng.standard_normal((images, 2))
    return torch.as_tensor(np.column_stack([tilts, rng.uniform(-150, 150, images)]))


def estimate(model, images, introduced_nm, options=None):
    data = RampData(images, cases.everything(images), NOISE, introduced_nm)
    start = start_from_defocus(model, data, 0.5 * introduced_nm)
    return fit_ramp(model, data, start, options or LiftOptions()).result


@pytest.mark.slow
@pytest.mark.parametrize("mag_j", [9, 18])
def test_lift_is_unbiased_efficient_and_its_error_bars_hold(model, mag_j):
    images = 400
    true = random_modes(images, seed=mag_j)
    flux = cases.photons(mag_j)
    result = estimate(model, drawn(model, true, flux, seed=100 + mag_j), true[:, 2].numpy())
    error = (result.zernike_nm - true)[:, 2].numpy()
    bound = cramer_rao_nm(ImageModel(model), true, torch.full((images,), flux), NOISE)[:, 2].numpy()
    rmse, expected = np.sqrt(np.mean(error**2)), np.sqrt(np.mean(bound**2))
    assert result.solution.converged.all()
    assert abs(error.mean()) < 3.5 * expected / np.sqrt(images)
    assert abs(rmse / expected - 1) < 0.10
    inside = np.abs((result.zernike_nm - true).numpy()) < result.sigma_nm.numpy()
    assert 0.63 < inside.mean() < 0.73
    assert abs(float(result.chi2_nu.mean()) - 1) < 0.01


def test_at_zero_flux_map_returns_the_prior_with_its_covariance(model):
    mean, sigma = torch.tensor([[10.0, -20.0, 55.0]]), torch.tensor([30.0, 40.0, 50.0])
    rng = np.random.default_rng(1)
    images = torch.as_tensor(0.01 * rng.standard_normal((1, 40, 40)), dtype=torch.float32)
    options = LiftOptions("model", mean.double(), sigma.double())
    noise, everything = NoiseModel(1.0, 100.0), cases.everything(images)
    result = lift(ImageModel(model), images, everything, noise, mean.double(), options)
    assert torch.allclose(result.zernike_nm, mean.double(), atol=0.05)
    assert torch.allclose(result.covariance_nm2[0], torch.diag(sigma.double() ** 2), rtol=1e-2, atol=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("mag_j", [12, 19])
def test_a_wrong_prior_biases_map_by_its_share_of_the_information(model, mag_j):
    """Truth: the normal distribution, whose mean given data and prior is that of both, weighted by precision.

    The prior of the defocus is 100 nm off and 50 nm wide, where 0 is true.
    """
    frames, off_nm, width_nm = 200, 100.0, 50.0
    flux = cases.photons(mag_j)
    images = drawn(model, torch.zeros(frames, 3, dtype=torch.float64), flux, seed=mag_j)
    mean = torch.tensor([[0.0, 0.0, off_nm]], dtype=torch.float64).repeat(frames, 1)
    sigma = torch.tensor([torch.inf, torch.inf, width_nm], dtype=torch.float64)
    found = estimate(model, images, np.zeros(frames), LiftOptions("model", mean, sigma)).zernike_nm[:, 2]
    bound = float(cramer_rao_nm(ImageModel(model), mean[:1] * 0, torch.tensor([flux]), NOISE)[0, 2])
    share = bound**2 / (bound**2 + width_nm**2)
    scatter = bound * (1 - share) / np.sqrt(frames)
    assert float(found.mean()) == pytest.approx(share * off_nm, abs=4 * scatter + 0.1 * share * off_nm)


def test_a_frame_of_nan_is_flagged_and_the_others_are_estimated(model):
    true = random_modes(3, seed=5)
    images = drawn(model, true, cases.photons(12), seed=6)
    images[1, 10, 10] = float("nan")
    result = lift(ImageModel(model), images, cases.everything(images), NOISE, true * 0.9)
    assert result.solution.status[1] == "invalid"
    assert torch.allclose(result.zernike_nm[[0, 2]], true[[0, 2]], atol=2.0)


@pytest.mark.slow
def test_frames_that_all_converge_to_a_wrong_defocus_are_found_though_none_stands_out(model):
    """All end near the opposite defocus: none fits better than the others, only the scan can decide."""
    true = torch.zeros(4, 3, dtype=torch.float64)
    true[:, 2] = torch.linspace(480, 552, 4)
    images = drawn(model, true, cases.photons(12), seed=12)
    data = RampData(images, cases.everything(images), NOISE, true[:, 2].numpy())
    start = start_from_defocus(model, data, np.zeros(4))
    first = lift(ImageModel(model), images, data.good, NOISE, start)
    assert (first.solution.converged & ((first.mode(4)[0] - true[:, 2]).abs() > 100)).all()
    result = fit_ramp(model, data, start, LiftOptions()).result
    assert torch.allclose(result.mode(4)[0], true[:, 2], atol=5)


def photon_fit(model, images, mask=None) -> PhotonFit:
    mask = cases.everything(images) if mask is None else mask
    layout = Layout(TTF, prior_sigma_nm=torch.tensor([300.0, 300.0, 200.0]))
    return PhotonFit(ImageModel(model), layout, images[:, None].flatten(2), mask.flatten(), NOISE)


def test_the_slope_with_variances_that_follow_is_that_of_the_objective():
    """Truth: central differences, in float64."""
    precise = PsfModel(cases.settings(64, TWO_COLOURS), TTF, dtype=torch.float64)
    at = random_modes(1, seed=3)
    problem = photon_fit(precise, drawn(precise, at, 2e4, seed=4).double())
    x = torch.cat([at + 15.0, torch.tensor([[2.1e4, 0.3]])], dim=1).double()
    first = torch.arange(1)
    _, gradient, hessian = problem.normal_equations(x, first)
    steps = dict(enumerate((1e-3 * hessian[0].diagonal() ** -0.5).tolist()))
    assert_gradient(lambda at: problem.objective(at, first), gradient, x, steps, rel=1e-4, abs=1e-6)


def test_the_scan_finds_defocus_and_position_of_any_image():
    """To 60 nm, from where every fit finds its minimum, and a pixel; a diversity shows the sign."""
    case = cases.settings(64, TWO_COLOURS, diversity={6: -170.0})
    model = PsfModel(case, TTF)
    focus_nm = np.linspace(-640.0, 640.0, 33)
    true = random_modes(len(focus_nm), seed=51)
    true[:, 2] = torch.as_tensor(focus_nm)
    images = drawn(model, true, 1e5, seed=52)
    found = scan_start_nm(model, images, cases.everything(images))
    pixel_nm = case.pixel_scale_mas * MAS * case.geometry.diameter_m / 4 * 1e9
    assert ((found - true)[:, 2].abs() <= 60.0).all()
    assert ((found - true)[:, :2].abs() <= pixel_nm).all()


@pytest.mark.slow
@pytest.mark.parametrize(("loss", "nominal"), [("huber", 1.0), ("l1", 1.06)])
def test_errors_of_a_robust_loss_hold_and_are_not_smaller_than_those_of_the_likelihood(model, loss, nominal):
    """Truth: Monte Carlo, and the Cramér-Rao bound that holds for every unbiased estimate.

    Errors of L1 are known to be 6 % too small (three other sets of images, ± 2 %), see `robust_covariance`.
    """
    images = 300
    true, flux = random_modes(images, seed=11), cases.photons(14)
    data = drawn(model, true, flux, seed=12)
    result = estimate(model, data, true[:, 2].numpy(), LiftOptions(loss=loss))
    pull = ((result.zernike_nm - true) / result.sigma_nm).numpy()
    bound = cramer_rao_nm(ImageModel(model), true, torch.full((images,), flux), NOISE)[:, 2]
    assert result.solution.converged.all()
    assert np.abs(pull.mean(0)).max() < 4 / np.sqrt(images)
    assert np.sqrt(np.mean(pull**2)) == pytest.approx(nominal, abs=0.08)
    assert float((result.sigma_nm[:, 2] / bound).median()) > 1.0
    assert float(result.chi2_nu.mean()) == pytest.approx(1, abs=0.02)


# -- realisations of a frame, near its wavefront -------------------------------------------------


NOLLS, REALISATIONS = (2, 3, 4, 5, 7, 8), 12
FRAME_NM = torch.tensor([5.0, -8, 60, 20, -15, 10]).double()
LIMIT = torch.tensor([20.0, 20.0, 40.0, 20.0, 20.0, 20.0]).double()


@pytest.fixture(scope="module")
def halo_model() -> ImageModel:
    effects = cases.halo_and_jitter
    psf = PsfModel(cases.settings(32, cases.J_AND_H[1::3], pupil_samples=64), NOLLS)
    known = effects(psf)
    return ImageModel(psf, known.held(known.starts))


def realisations(halo_model: ImageModel, flux_e: float) -> torch.Tensor:
    mean_e = halo_model.predict(FRAME_NM[None], torch.full((1,), flux_e).double(), torch.zeros(1).double())
    return cases.draw_frames(mean_e[0].numpy(), REALISATIONS, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize(("flux_e", "prior"), [(3e5, None), (3e3, LIMIT)])
def test_estimates_near_a_wavefront_are_those_of_the_exact_model(halo_model, flux_e, prior):
    images_e = realisations(halo_model, flux_e)
    start_nm = torch.zeros(REALISATIONS, len(NOLLS)).double()
    fitted = images_e, cases.everything(images_e), cases.READ_NOISE, start_nm
    options = LiftOptions(noise="model", prior_sigma_nm=prior)
    theirs = lift(halo_model, *fitted, options)
    near_nm = FRAME_NM + torch.linspace(-10.0, 10.0, REALISATIONS)[:, None]
    ours = lift(halo_model, *fitted, options, near=near(halo_model, near_nm))
    assert ours.solution.converged.all()
    assert float(((ours.zernike_nm - theirs.zernike_nm).abs() / theirs.sigma_nm).max()) < 0.1
    assert ours.sigma_nm.numpy() == pytest.approx(theirs.sigma_nm.numpy(), rel=0.3)


@pytest.mark.slow
def test_a_near_model_is_exact_there_and_its_derivatives_are_those_of_its_images(halo_model):
    images_e, layout, which = realisations(halo_model, 3e4), Layout(NOLLS), torch.arange(REALISATIONS)
    model = near(halo_model, FRAME_NM.expand(REALISATIONS, -1))
    variance = torch.full_like(images_e, 100.0)
    fit = image_problem(model, layout, images_e, variance, cases.everything(images_e))
    x = layout.start(images_e.flatten(1), FRAME_NM)
    there = halo_model.predict(FRAME_NM[None], x[:1, -2], x[:1, -1]).flatten(1)
    assert float((fit.predict_all(x[:1]) - there).abs().max()) < 1e-5 * float(there.max())
    x[:, :-2] += 15.0
    gradient, equations = fit.gradient(x, which)[1], fit.normal_equations(x, which)[1]
    assert torch.allclose(gradient, equations, rtol=1e-4, atol=1e-4 * float(gradient.abs().max()))
    steps, size = {0: 1.0, 2: 1.0, 5: 1.0, -2: 100.0}, float(gradient.abs().max())
    assert_gradient(lambda at: fit.gradient(at, which)[0], gradient, x, steps, abs=0.01 * size)


@pytest.mark.slow
def test_fits_that_leave_the_limits_of_a_near_model_are_given_up_and_the_others_are_not(halo_model):
    images_e = realisations(halo_model, 3e4)[:3]
    start_nm = torch.zeros(3, len(NOLLS)).double()
    start_nm[1, 2] = FRAME_NM[2] + 1.2 * REACH_NM
    good, options = cases.everything(images_e), LiftOptions(noise="model")
    close = near(halo_model, FRAME_NM.expand(3, -1))
    found = lift(halo_model, images_e, good, cases.READ_NOISE, start_nm, options, near=close)
    assert found.solution.converged.tolist() == [True, False, True]
    assert found.solution.iterations[1] == 0


# The Cramér-Rao bound. Truth: Fisher matrices by automatic differentiation of images, and analysis.


CRAMER_RAO_NOLLS = (2, 3, 4, 5, 7)
CRAMER_RAO_NOISE = NoiseModel(1.3, 9.0)


@pytest.fixture(scope="module")
def model_of_cramer_rao() -> PsfModel:
    return PsfModel(settings(32, J_AND_H[1::3]), CRAMER_RAO_NOLLS, dtype=torch.float64)


@pytest.fixture(scope="module")
def wavefronts() -> torch.Tensor:
    return torch.cat([vector(ncpa_nm(seed, 7, 80.0), CRAMER_RAO_NOLLS) for seed in (1, 2, 3)])


def bound_by_differentiation(model_of_cramer_rao, x, flux_e, optics, background_e) -> np.ndarray:
    """Standard errors from the Fisher matrix of modes, flux and background."""

    def image(modes):
        return model_of_cramer_rao.images(modes[None], optics)[0].flatten()

    with torch.enable_grad():
        by_modes = flux_e * torch.func.jacfwd(image)(x)
    light = image(x)
    jacobian = torch.column_stack([by_modes, light, torch.ones_like(light)]).numpy()
    mean_e = (flux_e * light + background_e).numpy()
    variance = CRAMER_RAO_NOISE.excess_noise_factor * mean_e + CRAMER_RAO_NOISE.floor_e2
    return np.sqrt(np.diag(np.linalg.inv(jacobian.T @ (jacobian / variance[:, None]))))[: len(x)]


@pytest.mark.parametrize("background_e", [0.0, 20.0])
@pytest.mark.parametrize("blurred", [False, True])
def test_the_bound_is_the_inverse_of_the_fisher_matrix(
    model_of_cramer_rao, wavefronts, blurred, background_e
):
    effects = halo_and_jitter(model_of_cramer_rao)
    whole = ImageModel(model_of_cramer_rao, effects.held(effects.starts) if blurred else ())
    flux = torch.tensor([1e4, 1e5, 1e6], dtype=torch.float64)
    ours = cramer_rao_nm(whole, wavefronts, flux, CRAMER_RAO_NOISE, background_e=background_e).numpy()
    theirs = [
        bound_by_differentiation(model_of_cramer_rao, x, float(f), whole.optics, background_e)
        for x, f in zip(wavefronts, flux, strict=True)
    ]
    assert ours == pytest.approx(np.array(theirs), rel=1e-4)


@pytest.mark.parametrize(
    ("noise", "flux_e", "gain"), [(NoiseModel(1.0, 1e-9), 1e5, 2.0), (NoiseModel(1e-9, 1e4), 1e4, 4.0)]
)
def test_four_times_the_light_halves_the_error_of_photon_noise_and_quarters_that_of_reads(
    model_of_cramer_rao, wavefronts, noise, flux_e, gain
):
    whole = ImageModel(model_of_cramer_rao)
    faint, bright = (
        cramer_rao_nm(whole, wavefronts, torch.full((3,), flux), noise) for flux in (flux_e, 4 * flux_e)
    )
    assert (faint / bright).numpy() == pytest.approx(gain, rel=1e-3)


# Robust fits of the frames of a cube, which share their linearisation.
# Truth: scipy's BFGS on the loss of the same images in float64, its gradient by automatic
# differentiation (other minimiser, other derivatives), finite differences, and the same fits in
# one thread. That the wavefronts are the right ones where the model is, test_calibration.py holds.


FRAME_FITS_NOLLS = tuple(range(2, 12))
DRAWN = tuple(range(2, 31))
FRAMES, FLUX, SCATTER_NM = 12, 3e6, 15.0


def problem(dtype=torch.float32, frames: int = FRAMES) -> tuple[ImageFit, torch.Tensor]:
    """Frames with modes that the fitted model misses, and the coefficients of those it has."""
    rng = np.random.default_rng(7)
    scatter_nm = SCATTER_NM * torch.as_tensor(rng.standard_normal((frames, len(DRAWN))))
    true = cases.vector(cases.ncpa_nm(4, 30), DRAWN) + scatter_nm
    sampled = cases.settings(32).for_single_frames()
    clean = PsfModel(sampled, DRAWN).images(true).double().clamp_min(0).numpy() * FLUX
    drawn = torch.cat([cases.draw_frames(image, 1, seed=k) for k, image in enumerate(clean)])
    images = drawn.flatten(1)[:, None].to(dtype)
    variance = cases.READ_NOISE.variance_e2(images.double().mean(0, keepdim=True))
    model = ImageModel(PsfModel(sampled, FRAME_FITS_NOLLS, dtype=dtype))
    return ImageFit(model, Layout(FRAME_FITS_NOLLS), images, variance, loss=LOSSES["l1"]), true[
        :, : len(FRAME_FITS_NOLLS)
    ]


def start(fit: ImageFit, true_nm: torch.Tensor) -> torch.Tensor:
    return fit.layout.start(fit.images[:, 0], true_nm.mean(0))


@pytest.fixture(scope="module")
def solved():
    fit, true = problem()
    return fit, true, fit_frames(fit, start(fit, true), max_iterations=60)


def test_every_frame_reaches_the_loss_that_an_independent_minimiser_reaches(solved):
    found = solved[-1]
    exact, _ = problem(torch.float64)
    assert set(found.status) == {CONVERGED}
    for frame in (0, 5, 11):
        best = minimum(exact, found.values[frame], frame)
        reached = exact.objective(found.values[frame : frame + 1], torch.tensor([frame])).item()
        assert reached < 1.002 * best


def minimum(fit: ImageFit, near: torch.Tensor, frame: int) -> float:
    """Lowest loss about some parameters, by scipy."""
    which = torch.tensor([frame])
    scale = torch.cat([torch.full((len(FRAME_FITS_NOLLS),), 5.0), torch.tensor([1e4, 1.0])])

    def loss(u: np.ndarray) -> tuple[float, np.ndarray]:
        v = torch.as_tensor(u).requires_grad_()
        value = fit.objective(near + scale * v[None], which).sum()
        value.backward()
        return value.item(), v.grad.numpy()

    return minimize(loss, np.zeros(len(scale)), jac=True, method="BFGS").fun


@pytest.mark.parametrize("processes", [None, partial(forked_map, 2)], ids=["threads", "processes"])
def test_results_are_the_same_to_the_bit_for_any_number_of_workers(solved, processes, monkeypatch):
    monkeypatch.setattr(quasi_newton, "FRAMES_PER_PIECE", 8)
    fit, true, _ = solved
    found = fit_frames(fit, start(fit, true), max_iterations=60)
    with workers(2, processes):
        again = fit_frames(fit, start(fit, true), max_iterations=60)
    assert torch.equal(again.values, found.values)
    assert again.status == found.status


def test_the_gradient_is_that_of_finite_differences():
    fit, true = problem(torch.float64, frames=2)
    x, both = start(fit, true), torch.arange(2)
    value, gradient = fit.gradient(x, both)
    assert value.numpy() == pytest.approx(fit.objective(x, both).numpy(), rel=1e-12)
    steps = {0: 1e-3, 5: 1e-3, len(FRAME_FITS_NOLLS): 1.0, len(FRAME_FITS_NOLLS) + 1: 1e-3}
    assert_gradient(lambda at: fit.objective(at, both), gradient, x, steps, rel=1e-4)
