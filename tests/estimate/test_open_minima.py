"""Other minima of the fit of all modes, the other side of a stop, and effects that a diagnosis found.

Truth: images by the simulator, which shares no optics with the model, with a tail of 20 nm in every mode;
weights and priors as they are defined; images of known modes; the side on which a stop was when images were
made by the model itself (same code: what is tested is where the fit goes).
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases
from helpers.simulated_scenes import image

from irlos_pipe.effects import FixedEffect, TipTiltJitter
from irlos_pipe.effects.companion import Companion
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.redrawn_pupil import PupilMisregistration
from irlos_pipe.estimate import calibration, open_minima
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.cube_fit import CubeFit
from irlos_pipe.estimate.image_fit import Layout
from irlos_pipe.estimate.open_fit import Opened, OpenFit, TailLaw, last_noll_of, open_basis, visible_order
from irlos_pipe.estimate.open_minima import Softening, by_curvature, likelier_minimum
from irlos_pipe.estimate.open_sides import likelier_side
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf import PsfModel

WINDOW, TAIL_NM, FLUX_E, FRAMES, SEED = 40, 20.0, 4e6, 20, 3
FIRST = torch.zeros(1, dtype=torch.int64)
LAW = TailLaw(22, 3.0, 1.0)


@pytest.fixture(scope="module")
def truth_nm() -> dict[int, float]:
    """NCPAs, and a tail of 20 nm in every mode that the window shows."""
    beyond = range(52, last_noll_of(visible_order(cases.settings(WINDOW))) + 1)
    drawn = TAIL_NM * np.random.default_rng(SEED).standard_normal(len(beyond))
    return cases.ncpa_nm(SEED + 6) | dict(zip(beyond, drawn.tolist(), strict=True))


@pytest.fixture(scope="module")
def frames(truth_nm) -> Frames:
    image_e = image(window=(WINDOW, WINDOW), ncpa_nm=truth_nm) * FLUX_E
    images = cases.draw_frames(image_e, FRAMES, seed=12)
    return Frames(images, cases.everything(images), cases.READ_NOISE)


def error_nm(found: calibration.Calibration, truth_nm: dict[int, float]) -> float:
    """RMS error in Noll 2-30."""
    return float(np.linalg.norm(found.zernike_nm[:29] - [truth_nm[noll] for noll in range(2, 31)]))


@pytest.mark.slow
def test_a_tail_as_large_as_the_closed_basis_is_found(frames, truth_nm, monkeypatch):
    options = CalibrationOptions(prior=cases.PRIOR)
    found = calibrate(frames, cases.settings(WINDOW), options)
    assert error_nm(found, truth_nm) < 3
    assert found.chi2_nu < found.nominal.most
    assert found.frame_status == ["converged"]
    assert found.tail.sigma_nm([67, 100]) == pytest.approx([TAIL_NM, TAIL_NM], rel=0.5)
    monkeypatch.setattr(calibration, "likelier_minimum", lambda task, closed, opened, most: opened)
    once = calibrate(frames, cases.settings(WINDOW), options)
    assert error_nm(once, truth_nm) > 30
    assert once.chi2_nu > 10 * once.nominal.most


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


def task(*starts: torch.Tensor) -> SimpleNamespace:
    """What the search asks of a cube."""
    return SimpleNamespace(
        options=SimpleNamespace(max_iterations=60),
        starts=lambda problem: list(starts),
        released=lambda effects, closed: closed,
    )


def closed(problem: OpenFit, chi2_nu: float) -> tuple[SimpleNamespace, SimpleNamespace]:
    """A fit of the closed basis with this χ²/ν."""
    fit = SimpleNamespace(layout=problem.layout, reduced_chi2=lambda x: torch.tensor([chi2_nu]))
    return fit, SimpleNamespace(values=place())


def test_a_wrong_minimum_gives_way_to_the_right_one(problem):
    wrong = place()
    wrong[0, 5:9] += 150.0
    found = likelier_minimum(task(place()), closed(problem, 1e6), ended(problem, wrong), 1.4)
    assert float(found.problem.reduced_chi2(found.solution.values)[0]) < 1.4
    assert (found.solution.values - place())[0, :27].norm() < 5


def test_softened_weights_are_those_of_the_larger_variance(problem):
    """Also where the normal equations with the true weights are kept."""
    problem.normal_equations(place(), FIRST)
    data = problem.images
    variance = 30.0 * (data + 9.0) + (0.1 * data) ** 2
    other = OpenFit(problem.model, problem.layout, data, variance)
    softened = Softening(30.0, 0.1).of(problem)
    for own, expected in zip(
        softened.normal_equations(place(), FIRST), other.normal_equations(place(), FIRST), strict=True
    ):
        assert own.numpy() == pytest.approx(expected.numpy(), rel=1e-9)


@pytest.mark.slow
def test_shakes_by_the_curvature_follow_the_softened_likelihood(problem):
    """Draws of unit covariance in its metric have a mean square of the number of modes."""
    rng, x = np.random.default_rng(3), place()
    factor = open_minima.SOFTER * float(problem.reduced_chi2(x)[0])
    hessian = Softening(factor).of(problem).normal_equations(x, FIRST)[2][0, :27, :27]
    moves = torch.cat([by_curvature(problem, x, rng) - x for _ in range(40)])[:, :27]
    assert float(((moves @ hessian) * moves).sum(1).mean()) == pytest.approx(27, rel=0.2)


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
    task = CubeFit(frames, psf, CalibrationOptions(highest_noll=11, prior=cases.PRIOR), None, None)
    closed = task.fit([FixedEffect(STOP, [DISTANCE_M, direction_rad, 0.0], FREE)])
    opened = open_basis(*closed[:1], closed[1].values, max_iterations=30)
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


# -- effects that a diagnosis found --------------------------------------------------------------


PLACE = [0.01, 90.0, -70.0]  # flux ratio, x and y [mas]
NAMES = [parameter.name for parameter in Companion().parameters]


@pytest.fixture(scope="module")
def cube_fit() -> CubeFit:
    psf = PsfModel(cases.settings(), NOLLS, dtype=torch.float64)
    modes_nm = cases.vector(cases.ncpa_nm(4, highest_noll=11, total_nm=60.0), NOLLS)
    images = cases.draw_frames(psf.images(modes_nm)[0].double().numpy() * 3e6, 4, seed=5)
    frames = Frames(images, cases.everything(images), NoiseModel(1.0, 1.0))
    return CubeFit(frames, psf, CalibrationOptions(highest_noll=11, prior=cases.PRIOR), None, None)


def test_releasing_an_effect_changes_no_image(cube_fit):
    told, jitter = FixedEffect(Companion(), PLACE, NAMES), TipTiltJitter()
    held = cube_fit.fit([told.expected(), jitter])
    problem, values = cube_fit.released([told, jitter], held)
    assert problem.layout.size == held[0].layout.size + len(NAMES)
    before, after = held[0].predict(held[1].values), problem.predict(values)
    assert torch.allclose(after, before, rtol=1e-12, atol=1e-9)
    assert np.allclose(
        problem.model.effects.split(values[0, problem.layout.effect_values])["companion"], PLACE
    )
