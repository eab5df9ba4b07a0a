"""The open static wavefront. Truth: images by the simulator, which shares no optics with the model, with a
tail beyond the closed basis; the same problem as a plain `ImageFit`; draws of a known law; and Bessel
functions for the reach of a mode."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases
from helpers.simulated_scenes import image
from scipy.special import jnp_zeros

from irlos_pipe.effects import FixedEffect
from irlos_pipe.effects.colour import PlateScale
from irlos_pipe.effects.companion import Ghost
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.redrawn_pupil import PupilMisregistration
from irlos_pipe.estimate.calibration import Calibration, calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.image_fit import ImageFit, Layout
from irlos_pipe.estimate.methods import CubeFit
from irlos_pipe.estimate.open_fit import (
    Opened,
    OpenFit,
    Softening,
    TailLaw,
    fit_tail_law,
    last_noll_of,
    likelier_minimum,
    likelier_side,
    open_basis,
    visible_order,
)
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf import PsfModel

pytestmark = pytest.mark.xdist_group("open_fit")  # its fixtures serve all tests

REPORTED, TAIL = slice(0, 29), range(67, 232)
TAIL_NM, FLUX_E, FRAMES = 3.0, 4e6, 12


@pytest.mark.parametrize("window", [24, 32, 48])
def test_the_maximum_of_the_last_visible_order_lies_in_the_window(window):
    """A mode of order n has the transform J_{n+1}(πDa/λ)/(πDa/λ), with its maximum near that of J_{n+1}."""
    settings = cases.settings(window)
    order = visible_order(settings)
    reach = np.pi * 8.0 / 1600e-9 * window / 2 * cases.SCALE_MAS * cases.MAS_RAD
    assert order + 1 <= reach < order + 2
    assert jnp_zeros(order + 1, 1)[0] == pytest.approx(order + 1, rel=0.25)


def tail_problem(seed: int, law: TailLaw, noise_nm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Optimum, Hessian and prior of direct measurements of modes drawn from a law, under a wider one."""
    rng = np.random.default_rng(seed)
    nolls = np.array([*range(2, 30), *TAIL])
    sigma = np.where(nolls < 67, 50.0, 0.0)
    sigma[28:] = law.sigma_nm(TAIL)
    measured = sigma * rng.standard_normal(len(nolls)) + noise_nm * rng.standard_normal(len(nolls))
    precision = np.where(nolls < 67, 50.0, 2.0) ** -2.0
    hessian = np.diag(np.full(len(nolls), noise_nm**-2.0) + precision)
    return np.linalg.solve(hessian, measured / noise_nm**2), hessian, precision


def test_the_law_of_drawn_modes_is_found():
    """165 draws give ln A and p to 0.06 and 0.3 by the Fisher information of Gaussian draws."""
    true = TailLaw(67, 4.0, 1.5)
    found = [
        fit_tail_law(TailLaw(67), [*range(2, 30), *TAIL], *tail_problem(seed, true, 1.0))
        for seed in range(12)
    ]
    amplitude, slope = (np.array([getattr(one, name) for one in found]) for name in ("amplitude_nm", "slope"))
    assert np.log(amplitude).mean() == pytest.approx(np.log(4.0), abs=0.12)
    assert slope.mean() == pytest.approx(1.5, abs=0.4)


def small_problems() -> tuple[OpenFit, ImageFit, torch.Tensor]:
    """The same images, modes and priors as an `OpenFit` and as an `ImageFit`, and a place."""
    nolls = range(2, 29)
    model = ImageModel(PsfModel(cases.settings(24), nolls, dtype=torch.float64))
    x = torch.tensor([[*np.linspace(30, -20, 27), 1e6, 5.0]], dtype=torch.float64)
    data = torch.full((1, 1, 24 * 24), 900.0, dtype=torch.float64)
    law = TailLaw(22, 3.0, 1.0)
    known = torch.full((27,), 40.0, dtype=torch.float64)
    open_fit = OpenFit(model, Layout(tuple(nolls), prior_sigma_nm=known), data, data).with_law(law)
    known = known.clone()
    known[20:] = torch.as_tensor(law.sigma_nm(nolls))[20:]
    return open_fit, ImageFit(model, Layout(tuple(nolls), prior_sigma_nm=known), data, data), x


def test_an_open_fit_has_the_equations_of_its_prior_whatever_is_known():
    open_fit, image_fit, x = small_problems()
    which = torch.arange(1)
    open_fit.normal_equations(x, which)
    for place in (x, x + 1):
        expected = image_fit.normal_equations(place, which)
        for own, other in zip(open_fit.normal_equations(place, which), expected, strict=True):
            assert own.numpy() == pytest.approx(other.numpy(), rel=1e-9)
    other_law = open_fit.with_law(TailLaw(22, 1.0, 0.0))
    precision = 1.0 - open_fit.prior_precision[0, 20:27]
    change = other_law.normal_equations(x + 1, which)[2] - open_fit.normal_equations(x + 1, which)[2]
    assert torch.diagonal(change[0])[20:27].numpy() == pytest.approx(precision.numpy(), abs=1e-9)


@pytest.fixture(scope="module")
def calibrated():
    """Closed and open calibrations of simulated frames with a tail, and their errors in Noll 2-30."""
    case = cases.settings(64)
    drawn = TAIL_NM * np.random.default_rng(3).standard_normal(149)
    true_nm = cases.ncpa_nm(9) | dict(zip(range(52, 201), drawn.tolist(), strict=True))
    image_e = image(window=(64, 64), ncpa_nm=true_nm) * FLUX_E
    images = cases.draw_frames(image_e, FRAMES, seed=12)
    frames = Frames(images, cases.everything(images), cases.READ_NOISE)
    options = CalibrationOptions(prior=cases.PRIOR)
    fits = {
        "closed": calibrate(frames, case, replace(options, highest_noll=66)),
        "open": calibrate(frames, case, options, adjustable=[PlateScale(cases.SCALE_MAS), Ghost()]),
    }
    low_nm = np.array([true_nm[noll] for noll in range(2, 31)])
    return fits, {name: fit.zernike_nm[REPORTED] - low_nm for name, fit in fits.items()}


@pytest.mark.slow
def test_modes_beyond_the_closed_basis_do_not_bias_the_reported_ones(calibrated):
    fits, errors = calibrated
    assert np.linalg.norm(errors["closed"]) > 5  # the same frames without the open basis
    # Photons leave 0.3 nm, the discretisation and what the tail's law holds back 0.3 to 0.4 nm: four draws of
    # the frames 0.50 to 0.69, and processors draw differently.
    assert np.linalg.norm(errors["open"]) < 1.0
    assert fits["open"].chi2_nu == pytest.approx(1, abs=0.1)
    assert fits["open"].frame_status == ["converged"]
    assert fits["open"].options.highest_noll == "open" and not fits["open"].adjusted
    assert fits["open"].nolls == tuple(range(2, 232))


@pytest.mark.slow
def test_the_law_of_the_tail_is_that_of_the_truth(calibrated):
    """Modes of orders 11 to 18 have 3 nm, those of 19 and 20, with Noll 201 and beyond, less and nothing."""
    tail = calibrated[0]["open"].tail
    assert tail.sigma_nm([67, 150]) == pytest.approx([TAIL_NM, TAIL_NM], rel=0.35)


def test_a_hastened_fit_has_the_same_images_and_gradient_and_nearly_the_same_hessian():
    settings = cases.settings(24, [(nm, 1.0) for nm in (1300.0, 1310.0, 1700.0, 1710.0)])
    model = ImageModel(PsfModel(settings, range(2, 29), dtype=torch.float64))
    data = torch.full((1, 1, 24 * 24), 900.0, dtype=torch.float64)
    fit = OpenFit(model, Layout(model.psf.nolls), data, data)
    quick = fit.hastened()
    assert quick.few_colours is not None
    assert len(quick.few_colours.psf.settings.spectrum) == 2
    x, which = small_problems()[2], torch.arange(1)
    for own, other in zip(quick.cheap_gradient(x, which), fit.cheap_gradient(x, which), strict=True):
        assert torch.equal(own, other)
    exact, rough = (torch.diagonal(one.normal_equations(x, which)[2][0]) for one in (fit, quick))
    assert not torch.equal(exact, rough)
    assert rough.numpy() == pytest.approx(exact.numpy(), rel=0.02)


# Other minima of the fit of all modes, the other side of a stop, and effects that a diagnosis found.
# Truth: images by the simulator, which shares no optics with the model, with a tail of 20 nm in every mode;
# weights and priors as they are defined; images of known modes; the side on which a stop was when images were
# made by the model itself (same code: what is tested is where the fit goes).


WINDOW, OPEN_MINIMA_TAIL_NM, OPEN_MINIMA_FLUX_E, OPEN_MINIMA_FRAMES, SEED = 40, 20.0, 4e6, 20, 3
FIRST = torch.zeros(1, dtype=torch.int64)
LAW = TailLaw(22, 3.0, 1.0)


@pytest.fixture(scope="module")
def truth_nm() -> dict[int, float]:
    """NCPAs, and a tail of 20 nm in every mode that the window shows."""
    beyond = range(52, last_noll_of(visible_order(cases.settings(WINDOW))) + 1)
    drawn = OPEN_MINIMA_TAIL_NM * np.random.default_rng(SEED).standard_normal(len(beyond))
    return cases.ncpa_nm(SEED + 6) | dict(zip(beyond, drawn.tolist(), strict=True))


@pytest.fixture(scope="module")
def frames(truth_nm) -> Frames:
    image_e = image(window=(WINDOW, WINDOW), ncpa_nm=truth_nm) * OPEN_MINIMA_FLUX_E
    images = cases.draw_frames(image_e, OPEN_MINIMA_FRAMES, seed=12)
    return Frames(images, cases.everything(images), cases.READ_NOISE)


def error_nm(found: Calibration, truth_nm: dict[int, float]) -> float:
    """RMS error in Noll 2-30."""
    return float(np.linalg.norm(found.zernike_nm[:29] - [truth_nm[noll] for noll in range(2, 31)]))


@pytest.mark.slow
def test_a_tail_as_large_as_the_closed_basis_is_found(frames, truth_nm):
    """The first minimum errs by more than 30 nm."""
    options = CalibrationOptions(prior=cases.PRIOR)
    found = calibrate(frames, cases.settings(WINDOW), options)
    assert error_nm(found, truth_nm) < 3
    assert found.chi2_nu < found.nominal.most
    assert found.frame_status == ["converged"]
    assert found.tail.sigma_nm([67, 100]) == pytest.approx(
        [OPEN_MINIMA_TAIL_NM, OPEN_MINIMA_TAIL_NM], rel=0.5
    )


@pytest.fixture
def problem() -> OpenFit:
    """The noisy image of known modes."""
    nolls = tuple(range(2, 29))
    model = ImageModel(PsfModel(cases.settings(24), nolls, dtype=torch.float64))
    image_e = model.predict(place()[:, :27], place()[:, -2], place()[:, -1], model.effects.starts)
    data = torch.poisson(image_e.clamp_min(0), generator=torch.Generator().manual_seed(1)).reshape(1, 1, -1)
    known = torch.full((27,), 40.0, dtype=torch.float64)
    return OpenFit(model, Layout(nolls, prior_sigma_nm=known), data, data + 9.0).with_law(LAW)


def place() -> torch.Tensor:
    return torch.tensor([[*np.linspace(30, -20, 27), 1e6, 5.0]], dtype=torch.float64)


def ended(problem: OpenFit, x: torch.Tensor) -> Opened:
    """A fit that ended at a place."""
    objective = problem.objective(x, FIRST)
    return Opened(problem, SimpleNamespace(values=x, objective=objective, status=["converged"]), LAW)


def task(problem: OpenFit, *starts: torch.Tensor) -> SimpleNamespace:
    """What the search asks of a cube."""
    return SimpleNamespace(
        options=SimpleNamespace(max_iterations=60),
        starts=lambda problem: list(starts),
        problem=lambda effects: problem,
    )


def test_a_wrong_minimum_gives_way_to_the_right_one(problem):
    wrong = place()
    wrong[0, 5:9] += 150.0
    found = likelier_minimum(task(problem, place()), SimpleNamespace(chi2_nu=1e6), ended(problem, wrong), 1.4)
    assert float(found.problem.reduced_chi2(found.solution.values)[0]) < 1.4
    assert (found.solution.values - place())[0, :27].norm() < 5


def test_softened_weights_are_those_of_the_larger_variance(problem):
    """Also where the images and derivatives are known."""
    problem.normal_equations(place(), FIRST)
    data = problem.images
    variance = 30.0 * (data + 9.0) + (0.1 * data) ** 2
    other = OpenFit(problem.model, problem.layout, data, variance)
    softened = Softening(30.0, 0.1).of(problem)
    for own, expected in zip(
        softened.normal_equations(place(), FIRST), other.normal_equations(place(), FIRST), strict=True
    ):
        assert own.numpy() == pytest.approx(expected.numpy(), rel=1e-9)


# -- the other side of a displaced stop ----------------------------------------------------------


NOLLS = tuple(range(2, 12))
STOP = PupilMisregistration()
FREE = [parameter.name for parameter in STOP.parameters]
DISTANCE_M, DIRECTION_RAD = 0.06, -0.6


def opened_from(direction_rad: float) -> Opened:
    """Fit all modes to the image behind a stop, which begins in a direction; a fit of few iterations."""
    psf = PsfModel(cases.settings(), NOLLS, dtype=torch.float64)
    modes_nm = cases.vector(cases.ncpa_nm(4, highest_noll=11, total_nm=60.0), NOLLS)
    made = ImageModel(psf, [FixedEffect(STOP, [DISTANCE_M, DIRECTION_RAD, 0.0])])
    images = cases.draw_frames(psf.images(modes_nm, made.optics)[0].double().numpy() * 3e6, 4, seed=5)
    frames = Frames(images, cases.everything(images), NoiseModel(1.0, 1.0))
    task = CubeFit(frames, psf, CalibrationOptions(highest_noll=11, prior=cases.PRIOR))
    closed = task.fit([FixedEffect(STOP, [DISTANCE_M, direction_rad, 0.0], FREE)])
    opened = open_basis(closed.problem, closed, max_iterations=30)
    assert opened is not None
    return opened


def stop_of(opened: Opened) -> np.ndarray:
    values = opened.solution.values[0, opened.problem.layout.effect_values]
    distance_m, direction_rad, _ = values.tolist()
    return distance_m * np.array([np.cos(direction_rad), np.sin(direction_rad)])


@pytest.fixture(scope="module")
def wrong() -> Opened:
    return opened_from(DIRECTION_RAD + np.pi)


TRUE_M = DISTANCE_M * np.array([np.cos(DIRECTION_RAD), np.sin(DIRECTION_RAD)])


@pytest.mark.slow
def test_a_fit_on_the_wrong_side_goes_over_to_the_right_one(wrong):
    assert stop_of(wrong) @ TRUE_M <= 0  # on the other side, or at rest
    found = likelier_side(wrong, max_iterations=30)
    assert found.solution.objective[0] < wrong.solution.objective[0]
    assert stop_of(found) == pytest.approx(TRUE_M, abs=0.01)


# -- an instrument that is not quite as declared, and a ghost -----------------------------------------


@pytest.fixture(scope="module")
def unlike() -> tuple[Frames, dict[int, float]]:
    """Frames of an instrument with other pixels, a displaced stop, turned vanes and a ghost; its NCPAs."""
    true_nm = cases.ncpa_nm(5)
    effects = {
        "plate_scale": {"fraction": 0.005},
        "pupil_misregistration": {"dx_m": 0.04, "dy_m": -0.03, "rotation_deg": 2.0},
        "ghost": {"flux_ratio": 0.004, "sep_mas": 130.0, "pa_deg": 40.0, "defocus_nm": 60.0},
    }
    image_e = image(window=(WINDOW, WINDOW), ncpa_nm=true_nm, effects=effects) * OPEN_MINIMA_FLUX_E
    images = cases.draw_frames(image_e, OPEN_MINIMA_FRAMES, seed=8)
    return Frames(images, cases.everything(images), cases.READ_NOISE), true_nm


@pytest.mark.slow
def test_an_instrument_that_is_not_quite_as_declared_is_followed(unlike):
    frames, true_nm = unlike
    options = CalibrationOptions(prior=cases.PRIOR)
    adjusted = [PlateScale(cases.SCALE_MAS), STOP, Ghost()]
    found = calibrate(frames, cases.settings(WINDOW), options, adjustable=adjusted)
    assert found.adjusted and found.chi2_nu < found.nominal.most
    assert error_nm(found, true_nm) < 2
    assert found.effects["plate_scale"]["fraction"] == pytest.approx(0.005, abs=5e-4)
    stop, ghost = found.effects["pupil_misregistration"], found.effects["ghost"]
    assert [stop["dx_m"], stop["dy_m"]] == pytest.approx([0.04, -0.03], abs=0.005)
    assert stop["rotation_deg"] == pytest.approx(2.0, abs=0.3)
    assert [ghost["sep_mas"], ghost["pa_deg"]] == pytest.approx([130.0, 40.0], abs=2.0)
    assert ghost["flux_ratio"] == pytest.approx(0.004, rel=0.1)


@pytest.mark.slow
def test_what_leaves_much_is_not_adopted(unlike):
    frames, true_nm = unlike
    options = CalibrationOptions(prior=cases.PRIOR)
    found = calibrate(frames, cases.settings(WINDOW), options, adjustable=[Ghost()])
    assert not found.adjusted and found.chi2_nu > 2 * found.nominal.most
    assert error_nm(found, true_nm) > 6  # of the instrument as declared
