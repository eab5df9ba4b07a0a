"""Other minima of the fit of all modes. Truth: images by the simulator, which shares no optics with the
model, with a tail of 20 nm in every mode; weights and priors as they are defined; images of known modes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases
from helpers.simulated_scenes import image

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate import calibration, open_minima
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.image_fit import Layout
from irlos_pipe.estimate.open_fit import Opened, OpenFit, TailLaw, last_noll_of, visible_order
from irlos_pipe.estimate.open_minima import Softening, by_curvature, by_prior, likelier_minimum
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


@pytest.mark.parametrize(("chi2_nu", "before"), [(0.9, 100.0), (3.0, 5.0)])
def test_a_nominal_fit_and_one_that_no_modes_improve_are_left_as_they_are(
    problem, monkeypatch, chi2_nu, before
):
    monkeypatch.setattr(OpenFit, "reduced_chi2", lambda fit, x: torch.tensor([chi2_nu]))
    opened = ended(problem, place())
    assert likelier_minimum(None, closed(problem, before), opened, 1.0) is opened


def test_a_wrong_minimum_gives_way_to_the_right_one(problem):
    wrong = place()
    wrong[0, 5:9] += 150.0
    found = likelier_minimum(task(place()), closed(problem, 1e6), ended(problem, wrong), 1.4)
    assert float(found.problem.reduced_chi2(found.solution.values)[0]) < 1.4
    assert (found.solution.values - place())[0, :27].norm() < 5


@pytest.mark.slow
def test_the_fit_stays_where_no_likelier_minimum_is_found(problem, monkeypatch):
    monkeypatch.setattr(open_minima, "SHAKES", 1)
    wrong = place()
    wrong[0, 5:9] += 150.0
    right = likelier_minimum(task(place()), closed(problem, 1e6), ended(problem, wrong), 0.0)
    best = ended(problem, right.solution.values)
    assert likelier_minimum(task(place() + 400), closed(problem, 1e6), best, 0.0).solution.objective <= (
        best.solution.objective
    )


@pytest.mark.slow
@pytest.mark.parametrize(("off_nm", "shaken"), [(0.0, 0), (150.0, 2)])
def test_minima_are_disturbed_only_if_there_are_others_than_the_known_one(
    problem, monkeypatch, off_nm, shaken
):
    """Softened weights lead from the truth back to it, also where χ²/ν cannot fall below the limit."""
    tried = []
    monkeypatch.setattr(open_minima._Search, "_shaken", lambda search, best: tried.append(best) or best)
    known = place()
    known[0, 5:9] += off_nm
    likelier_minimum(task(place()), closed(problem, 1e6), ended(problem, known), 0.0)
    assert len(tried) == shaken


@pytest.mark.slow
def test_shakes_end_after_a_count_of_iterations_in_proportion(problem, monkeypatch):
    """Of three starts in vain, a search without a limit takes some hundred iterations for shakes."""
    spent = []
    lacks = SimpleNamespace(part=0.0)
    monkeypatch.setattr(open_minima, "lacking", lambda *_: lacks)
    monkeypatch.setattr(open_minima, "SHAKEN_TIMES", 0.5)

    class Counted(open_minima._Search):
        def _shaken(self, best):
            spent.append((self.spent, self.allowed))
            return super()._shaken(best)

    monkeypatch.setattr(open_minima, "_Search", Counted)
    known = place()
    known[0, 5:9] += 150.0
    likelier_minimum(task(place(), place() + 60), closed(problem, 1e6), ended(problem, known), 0.0)
    (first, allowed), (last, _) = spent[0], spent[-1]
    assert allowed == 1.5 * first
    assert first < last < allowed + 3 * open_minima.ITERATIONS


@pytest.mark.slow
def test_where_one_fact_explains_the_misfit_nothing_is_shaken(problem, monkeypatch):
    shaken = []
    monkeypatch.setattr(open_minima, "lacking", lambda *_: SimpleNamespace(part=0.6))
    monkeypatch.setattr(open_minima._Search, "_shaken", lambda search, best: shaken.append(best) or best)
    known = place()
    known[0, 5:9] += 150.0
    likelier_minimum(task(place()), closed(problem, 1e6), ended(problem, known), 0.0)
    assert not shaken


@pytest.mark.slow
def test_the_same_search_has_the_same_end_and_leaves_its_problem_alone(problem, monkeypatch):
    monkeypatch.setattr(open_minima, "SHAKES", 1)
    wrong = place() + 60.0
    weights, start = problem.root_weight.clone(), wrong.clone()
    ends = [
        likelier_minimum(task(wrong), closed(problem, 1e6), ended(problem, wrong), 0.0).solution.values
        for _ in range(2)
    ]
    assert torch.equal(*ends)
    assert torch.equal(problem.root_weight, weights)
    assert torch.equal(wrong, start)


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


def test_bad_pixels_keep_no_weight_when_weights_are_softened(problem):
    root = problem.root_weight.clone()
    root[0, 0, 100] = 0.0
    softened = Softening(3.0, 0.5).of(problem.reweighed(root))
    assert softened.root_weight[0, 0, 100] == 0
    assert bool((softened.root_weight[0, 0, 101:] > 0).all())


def test_shakes_by_the_prior_have_a_part_of_its_width_and_leave_tilt_and_focus(problem):
    rng, before = np.random.default_rng(2), place()
    moves = torch.cat([by_prior(problem, before, rng) - before for _ in range(300)])
    width = moves.std(0) / open_minima.PRIOR_PART
    assert torch.equal(before, place())
    assert bool((moves[:, [0, 1, 2, 27, 28]] == 0).all())
    assert width[3:20].numpy() == pytest.approx(np.full(17, 40.0), rel=0.2)
    assert width[20:27].numpy() == pytest.approx(LAW.sigma_nm(range(22, 29)), rel=0.2)


@pytest.mark.slow
def test_shakes_by_the_curvature_follow_the_softened_likelihood(problem):
    """Draws of unit covariance in its metric have a mean square of the number of modes."""
    rng, x = np.random.default_rng(3), place()
    factor = open_minima.SOFTER * float(problem.reduced_chi2(x)[0])
    hessian = Softening(factor).of(problem).normal_equations(x, FIRST)[2][0, :27, :27]
    moves = torch.cat([by_curvature(problem, x, rng) - x for _ in range(40)])[:, :27]
    assert float(((moves @ hessian) * moves).sum(1).mean()) == pytest.approx(27, rel=0.2)


def test_modes_without_curvature_are_shaken_by_the_prior(problem, monkeypatch):
    def none(fit, x, which):
        return None, None, torch.zeros(1, 29, 29, dtype=torch.float64)

    monkeypatch.setattr(OpenFit, "normal_equations", none)
    moved = by_curvature(problem, place(), np.random.default_rng(4))
    assert torch.equal(moved, by_prior(problem, place(), np.random.default_rng(4)))
