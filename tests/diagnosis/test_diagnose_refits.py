"""Fits of candidates and what is chosen of them, on frames drawn from the model itself (same code).

Truth: what was put into the frames, and mpmath's incomplete beta function.
"""

from dataclasses import replace

import mpmath
import numpy as np
import pytest
import torch
from helpers import diagnose_frames
from helpers.diagnose_frames import (
    CASE,
    CONDITIONS,
    NOLLS,
    OPTIONS,
    WINDOW,
    cube,
    frames,
    image,
    model,
    optimum,
)
from scipy import stats

from irlos_pipe.diagnosis.checks import bad_pixel_family
from irlos_pipe.diagnosis.effect_sizes import determined
from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.null_model import Optimum, gaussian_sigma
from irlos_pipe.diagnosis.scores import families, scores
from irlos_pipe.diagnosis.search import Task
from irlos_pipe.diagnosis.view import Exposures, Moment, Moments, View
from irlos_pipe.diagnosis.workflow import diagnose
from irlos_pipe.effects import CATALOGUE, Conditions
from irlos_pipe.effects.colour import PlateScale
from irlos_pipe.effects.detector import BackgroundGradient
from irlos_pipe.effects.public_values import public_sigma
from irlos_pipe.numerics.parallel import workers
from irlos_pipe.optics.psf import PsfModel


def fitter_of(stack) -> Fitter:
    return Fitter([View(model(), CONDITIONS)], stack)


def test_priors_cost_what_they_cost_however_soon_a_fit_was_ended():
    stack = cube(image()).training
    ended = fitter_of(stack).explored([], iterations=2)
    sigma = ended.problem.prior_precision[0, ended.problem.layout.modes].numpy() ** -0.5
    assert not ended.converged
    assert ended.penalty == pytest.approx(np.sum((ended.modes_nm / sigma) ** 2), rel=1e-9)
    objective = 0.5 * (ended.chi2 + ended.penalty)
    assert float(ended.solution.objective[0]) == pytest.approx(objective, rel=1e-5)


def test_two_hot_pixels_are_one_effect_of_both():
    mean = image()
    mean[5, 22] += 60
    mean[25, 8] += 90
    at_rest = optimum(cube(mean).training)
    (found,) = scores(at_rest, bad_pixel_family(at_rest))
    assert (found.name, found.trials) == ("bad_pixels", WINDOW**2)
    fit = fitter_of(at_rest.stack).fit([found.whole()])
    assert fit.effect(found.name).base.describe(fit.values_of(found.name)) == {"pixels": [[25, 8], [5, 22]]}
    assert fit.values_of(found.name) == pytest.approx([90.0, 60.0], abs=6.0)
    assert abs(Optimum(at_rest.stack, fit).excess.significance) < 4


def test_a_significance_far_beyond_the_range_of_the_f_distribution_is_finite_and_right():
    for value, directions, count in ((3000.0, 3, 90.0), (4e4, 5, 3000.0), (1e5, 2, 2000.0)):
        freedom = count - directions
        f = value * freedom / (directions * (count - 1))
        x = freedom / (freedom + directions * f)
        tail = mpmath.betainc(freedom / 2, directions / 2, 0, x, regularized=True)
        wanted = -mpmath.log(tail)
        sigma = gaussian_sigma(value, directions, count)
        assert -stats.norm.logsf(sigma) == pytest.approx(float(wanted), rel=2e-3)


def test_the_error_of_a_direction_does_not_see_the_jump_at_zero():
    gradient, covariance = BackgroundGradient(), np.diag([0.01, 0.01]) ** 2
    sigma = public_sigma(gradient, np.array([0.5, 0.0]), covariance)
    assert sigma["angle_deg"] == pytest.approx(np.rad2deg(0.01 / 0.5), rel=1e-3)


def test_what_a_direction_without_size_does_not_determine_has_no_error_and_spoils_no_other():
    """A stop in its place has no direction: the covariance of that one is infinite."""
    stop = CATALOGUE["pupil_misregistration"].under(CONDITIONS)
    known = np.array([[4e-6, 1e-6], [1e-6, 9e-4]])
    covariance = np.diag([0.0, np.inf, 0.0])
    covariance[np.ix_([0, 2], [0, 2])] = known
    found = determined(stop.parameters, covariance)
    assert found[np.ix_([0, 2], [0, 2])] == pytest.approx(known)
    assert (found[1] == 0).all() and (found[:, 1] == 0).all()


@pytest.mark.slow
@pytest.mark.parametrize(("fraction", "name"), [(-0.045, "spectrum"), (-0.01, "plate_scale")])
def test_of_two_that_explain_as_much_alone_a_plausible_one_is_the_start(fraction, name):
    """5 % more wavelength is 5 % less of a pixel in a narrow band, which no lens makes; filters do differ."""
    data = cube(image(effect=PlateScale(9.7), values=[fraction]))
    moments = Moments({0: Moment("", "", CONDITIONS)})
    task = Task(data, fitter_of(data.training), moments, OPTIONS, lambda count: None, "photon-limited")
    alike = [one for one in families(moments, [])[0] if one.effect.name in ("plate_scale", "spectrum")]
    at_rest = optimum(data.training)
    assert [one.name for one in task._alone(at_rest, scores(at_rest, alike)).fitted.effects] == [name]


def under(monkeypatch, **settings) -> Conditions:
    """Conditions with other settings, with which images are drawn as well."""
    changed = replace(CONDITIONS, settings=replace(CASE, **settings))
    psf = PsfModel(changed.settings, NOLLS, dtype=torch.float64)
    monkeypatch.setattr(diagnose_frames, "model", lambda: psf)
    return changed


@pytest.mark.slow
def test_a_diagnosis_is_the_same_by_one_worker_and_by_two(monkeypatch):
    """To the bit: one thread computes each piece."""
    small = under(monkeypatch, window=(16, 16), pupil_samples=48)
    taken = Exposures(frames(image() + 2.0 * np.arange(16)), small)
    found = []
    for count in (1, 2):
        with workers(count):
            found.append(diagnose([taken], [], OPTIONS))
    one, two = found
    assert [step.name for step in one.steps] == ["background_gradient"]
    for what in ("modes_nm", "modes_sigma_nm", "excess_sigma"):
        assert np.array_equal(getattr(one, what), getattr(two, what)), what
    assert [step.public for step in one.steps] == [step.public for step in two.steps]
    assert one.mdb == two.mdb
    assert [repr(tried) for tried in one.tried] == [repr(tried) for tried in two.tried]


@pytest.mark.slow
def test_a_vibration_beside_a_faint_companion_is_no_double_star_that_nobody_resolves(monkeypatch):
    """Two equal stars 2 σ apart are as long, and their further parameters take a bit of the companion."""
    coarse = under(monkeypatch, pupil_samples=96)
    vibration = CATALOGUE["vibration"].under(coarse)
    shaken = image(effect=vibration, values=vibration.values_of(sigma_mas=6.0, angle_deg=60.0))
    both = frames((shaken + 0.006 * np.roll(shaken, (7, 5), (0, 1))) / 1.006)
    vibration, companion = diagnose([Exposures(both, coarse)], [], OPTIONS).steps
    assert (vibration.name, companion.name) == ("vibration", "companion")
    assert vibration.public["sigma_mas"] == pytest.approx(6.0, rel=0.02)
    assert companion.public["flux_ratio"] == pytest.approx(0.006, rel=0.05)
