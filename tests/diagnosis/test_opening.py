"""All visible modes beside effects, and other starts, on frames drawn from the model itself (same code).

Truth: what was put into the frames, and images of the same model with the modes known instead of free.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.diagnose_frames import CASE, CONDITIONS, FLUX_E, NOLLS, TRUE_NM, cube, fitted, image, model

from irlos_pipe.diagnosis.effect_sizes import Covariances
from irlos_pipe.diagnosis.fitted import begun_at
from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.naming import NamingTask
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.opening import Opening
from irlos_pipe.diagnosis.search.scores import Family, score_family
from irlos_pipe.diagnosis.significance import SURELY, gaussian_sigma, surely_exceeding, threshold
from irlos_pipe.diagnosis.starts import on_other_sides, other_sides
from irlos_pipe.diagnosis.view import View
from irlos_pipe.diagnosis.without import needless
from irlos_pipe.effects import CATALOGUE, FixedEffect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.open_fit import last_noll_of, visible_order
from irlos_pipe.optics.psf import PsfModel

TAIL_NM, ALL = 6.0, tuple(range(2, last_noll_of(visible_order(CASE)) + 1))
COMPANION = CATALOGUE["companion"].under(CONDITIONS)
PLACE = (0.01, 85.0, -70.0)  # of the star's light, and mas
BUMP, BUMP_VALUES = "phase_bump", (400.0, 1.6, 1.4, 0.8)  # nm and m
STOP = CATALOGUE["pupil_misregistration"].under(CONDITIONS)


def with_tail(effects=()) -> np.ndarray:
    """Mean image with modes beyond the fitted ones, and effects at their values."""
    drawn = np.random.default_rng(3).standard_normal(len(ALL)) * TAIL_NM
    modes = [TRUE_NM.get(noll, 0.0) if noll in NOLLS else nm for noll, nm in zip(ALL, drawn, strict=True)]
    whole = ImageModel(PsfModel(CASE, ALL, dtype=torch.float64), list(effects))
    vector = torch.tensor([modes], dtype=torch.float64)
    flux, none = torch.tensor([10 * FLUX_E], dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    return whole.predict(vector, flux, none, torch.zeros(0, dtype=torch.float64))[0].numpy()


def opened(mean_e: np.ndarray):
    """Training frames, their fitter, and all modes fitted."""
    training = cube(mean_e).training
    fitter = Fitter([View(model(), CONDITIONS)], training)
    opening = Opening.of(fitter, [], fitted(training), {})
    assert opening is not None
    return training, fitter, opening


@pytest.fixture(scope="module")
def beside_a_companion():
    return opened(with_tail([FixedEffect(COMPANION, PLACE)]))


@pytest.fixture(scope="module")
def alone():
    return opened(with_tail())


def second_image(training, opening):
    return score_family(opening.optimum(training), Family((COMPANION,)))


def test_modes_imitate_a_companion_but_would_rather_not(beside_a_companion):
    training, fitter, opening = beside_a_companion
    score = second_image(training, opening)
    further = Opening.of(fitter, [score.start()], opening.fitted, opening.beyond_nm)
    assert further is not None
    ratio, x_mas, y_mas = further.fitted.values_of("companion")[:3]
    assert score.significance > 5
    assert opening.deviance() - further.deviance() > threshold(3, score.trials)
    assert (x_mas, y_mas) == pytest.approx(PLACE[1:], abs=4.0)
    assert ratio == pytest.approx(PLACE[0], rel=0.15)


def test_beside_all_modes_no_companion_is_seen_where_there_is_none(alone):
    training, _, opening = alone
    assert second_image(training, opening).significance < 5


def test_beside_the_closed_basis_alone_the_tail_would_pass_for_a_companion(alone):
    """The reason for which all modes are fitted."""
    training, _, opening = alone
    closed = Fitter([View(model(), CONDITIONS)], training).finished(opening.closed)
    assert score_family(Optimum(training, closed), Family((COMPANION,))).significance > 5


def bump_beside_all_modes(mean_e):
    """Whether a bump is needed beside the closed basis, beside all modes and named; its size and error."""
    training = cube(mean_e).training
    fitter = Fitter([View(model(), CONDITIONS)], training)
    null = fitted(training)
    start = score_family(Optimum(training, null), Family(CATALOGUE[BUMP].variants(CONDITIONS))).start()
    closed = fitter.finished(fitter.explored([start], null))
    opening = Opening.of(fitter, closed.continued(), closed, {})
    assert opening is not None
    both = [not needless(one, [BUMP], training, 5.0) for one in (closed, opening.fitted)]
    search = SimpleNamespace(all_modes=opening, options=SimpleNamespace(sure=5.0))
    search.allowing = lambda _: SimpleNamespace(cube=SimpleNamespace(training=training))
    named = NamingTask._sure(search, Optimum(training, closed), []) == [BUMP]
    sigma = Covariances(training, [opening.fitted, closed]).of(BUMP)[0, 0] ** 0.5
    return [*both, named], opening.fitted.values_of(BUMP)[0], sigma


@pytest.mark.slow
def test_a_bump_that_stands_in_for_modes_is_not_needed_beside_them():
    needed, _, _ = bump_beside_all_modes(with_tail())
    assert needed == [True, False, False]


@pytest.mark.slow
def test_a_bump_that_is_there_is_needed_beside_all_modes_and_its_error_knows_of_them():
    bump = CATALOGUE[BUMP].under(CONDITIONS)
    mean_e = with_tail([FixedEffect(bump, BUMP_VALUES)])
    needed, nm, sigma_nm = bump_beside_all_modes(mean_e)
    assert needed == [True, True, True]
    assert nm == pytest.approx(BUMP_VALUES[0], abs=4 * sigma_nm)
    assert TAIL_NM < sigma_nm < BUMP_VALUES[0] / 5


def test_errors_of_modes_know_of_those_beyond(alone):
    """As large as the errors are that were made; beside known modes beyond they are far too small."""
    training, fitter, opening = alone
    closed = fitter.of(training, opening.with_known_modes().views).at(opening.with_known_modes())
    models = [opening.fitted, closed], [closed]
    sigma = [Covariances(training, some).modes_sigma_nm()[2:] for some in models]
    error = closed.modes_nm[2:] - [TRUE_NM.get(noll, 0.0) for noll in NOLLS[2:]]
    pulls = [float(np.sqrt(np.mean((error / one) ** 2))) for one in sigma]
    assert 0.5 < pulls[0] < 1.6
    assert pulls[1] > 1.5 * pulls[0]


def test_known_modes_have_the_image_of_free_ones(alone):
    training, fitter, opening = alone
    known = opening.with_known_modes()
    same = fitter.of(training, known.views).at(known).image_e
    assert (same - opening.fitted.image_e).abs().max() < 2e-4 * same.max()


def test_a_stop_that_came_to_rest_begins_where_the_fit_falls():
    distance_m, direction_rad = 0.06, 0.9
    training = cube(image(effect=STOP, values=(distance_m, direction_rad, 0.0))).training
    fitter = Fitter([View(model(), CONDITIONS)], training)
    centred = begun_at(STOP, np.array([0.0, direction_rad + np.pi, 0.0]))
    resting = fitter.begun([centred], fitted(training))
    (side,) = other_sides(resting, STOP.name)
    best = fitter.explored([begun_at(STOP, side)], resting)
    assert best.chi2 < resting.chi2 - 25
    assert best.values_of(STOP.name)[0] == pytest.approx(distance_m, abs=0.01)
    assert np.cos(best.values_of(STOP.name)[1] - direction_rad) > 0.9


@pytest.mark.slow
def test_a_stop_that_rests_beside_all_modes_is_found_on_its_side_by_all_of_them():
    distance_m, direction_rad = 0.06, 0.9
    training = cube(with_tail([FixedEffect(STOP, (distance_m, direction_rad, 0.0))])).training
    fitter = Fitter([View(model(), CONDITIONS)], training)
    centred = begun_at(STOP, np.array([0.0, direction_rad + np.pi, 0.0]))
    resting = Opening.of(fitter, [centred], fitted(training), {})
    assert resting is not None
    others = on_other_sides(resting.fitted)
    turned = [Opening.of(fitter, effects, resting.fitted, resting.beyond_nm) for effects in others]
    best = min((one for one in turned if one is not None), key=Opening.deviance)
    distances, directions, _ = zip(*(one.fitted.values_of(STOP.name) for one in (resting, best)), strict=True)
    assert best.deviance() < resting.deviance() - 25
    assert distances[1] == pytest.approx(distance_m, abs=0.015)
    assert np.cos(directions[1] - direction_rad) > 0.9


@pytest.mark.parametrize("frames", [1.0, 1.5, 3.0])
def test_fewer_independent_frames_than_directions_are_no_error_and_little_evidence(frames):
    """One frame may say anything of three directions: T² must be enormous to mean something."""
    found = [gaussian_sigma(value, 3, frames) for value in (1.0, 100.0, 1e6)]
    assert np.isfinite(found).all()
    assert found == sorted(found)
    assert found[1] < 3 < gaussian_sigma(100.0, 3, np.inf)


@pytest.mark.parametrize(("limit", "directions"), [(36.0, 1), (45.0, 3), (100.0, 28)])
def test_an_effect_of_the_smallest_detectable_size_is_nearly_always_seen(limit, directions):
    """Monte Carlo: normal deviates that are off by this size exceed the limit as often as stated."""
    size = np.sqrt(surely_exceeding(limit, directions) / directions)
    drawn = np.random.default_rng(3).normal(size, 1.0, (40_000, directions))
    assert np.mean((drawn**2).sum(1) > limit) == pytest.approx(SURELY, abs=0.005)


def test_what_variances_allow_for_an_earlier_model_does_not_hide_how_much_better_a_later_one_is(alone):
    """Truth: the likelihood with the factor on the variances where it is largest, by a search."""
    opening = alone[2]
    freedom, penalty = opening.fitted.problem.freedom, opening.fitted.penalty

    def with_chi2(chi2):
        return replace(opening, fitted=replace(opening.fitted, chi2=chi2))

    for share, misfit in [(0.2, 16.0), (1.1, 16.0), (0.02, 16.0), (0.9, 1.0)]:
        chi2, scales = share * freedom, np.geomspace(1 / misfit, 10, 100_000)
        least = float((freedom * np.log(scales) + chi2 / scales).min()) + penalty
        assert with_chi2(chi2).deviance(misfit) == pytest.approx(least, rel=1e-6)
