"""The posterior of everything in a mean image: its noise, its evidence, and what it finds.

Truth: dense matrices, the exact marginal likelihood of a linear Gaussian model, and what was put into frames
that are drawn from the model itself (same code).
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.diagnose_frames import CASE, CONDITIONS, FLUX_E, NOLLS, OPTIONS, TRUE_NM, cube, fitted, model
from scipy.stats import multivariate_normal

from irlos_pipe.diagnosis.acceptance import Search
from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.posterior import Covariance, Linear, Posterior, WavefrontLaw, with_visible_modes
from irlos_pipe.diagnosis.search import Task, _sides
from irlos_pipe.diagnosis.view import Exposures, Moments, View
from irlos_pipe.effects import CATALOGUE, FixedEffect, in_other_forms
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.open_fit import last_noll_of, visible_order
from irlos_pipe.optics.psf import PsfModel

TAIL_NM, ALL = 6.0, tuple(range(2, last_noll_of(visible_order(CASE)) + 1))
COMPANION = CATALOGUE["companion"].under(CONDITIONS)
PLACE = (0.01, 85.0, -70.0)  # of the star's light, and mas
BUMP = CATALOGUE["phase_bump"].under(CONDITIONS)
BUMP_VALUES = (400.0, 1.6, 1.4, 0.8)  # nm and m
STOP = CATALOGUE["pupil_misregistration"].under(CONDITIONS)
STOP_VALUES = (0.06, 0.9, 0.0)  # m, rad, degrees


def with_tail(effects=()) -> np.ndarray:
    """Mean image with modes beyond the fitted ones, and effects at their values."""
    drawn = np.random.default_rng(3).standard_normal(len(ALL)) * TAIL_NM
    modes = [TRUE_NM.get(noll, 0.0) if noll in NOLLS else nm for noll, nm in zip(ALL, drawn, strict=True)]
    whole = ImageModel(PsfModel(CASE, ALL, dtype=torch.float64), list(effects))
    vector = torch.tensor([modes], dtype=torch.float64)
    flux, none = torch.tensor([10 * FLUX_E], dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    return whole.predict(vector, flux, none, torch.zeros(0, dtype=torch.float64))[0].numpy()


def dense(covariance: Covariance) -> np.ndarray:
    """The covariance that the sums of its parts make, pixel by pixel."""
    (one,) = covariance.scatter
    own = np.diag((one.photons_e2 + (covariance.flat_rms * one.image_e) ** 2).numpy())
    rms = (one.speckles_e2 + covariance.model_rms**2 * one.light_e.max() * one.light_e).sqrt()
    shapes = (one.airy.shapes * rms[:, None]).numpy()
    return own + shapes @ shapes.T + one.sample_e.numpy() @ one.sample_e.numpy().T


@pytest.mark.parametrize("photons", [True, False])
def test_whitened_shapes_have_the_products_of_the_dense_inverse_covariance(photons):
    training = cube(with_tail()).training.limited_by(photons)
    covariance = Covariance.of(training, [View(model(), CONDITIONS)])
    rng, whole = np.random.default_rng(0), dense(covariance)
    shapes = torch.as_tensor(rng.standard_normal((len(whole), 4)) * np.sqrt(np.diag(whole))[:, None])
    white = covariance.whiten(shapes).numpy()
    expected = shapes.numpy().T @ np.linalg.solve(whole, shapes.numpy())
    assert white.T @ white == pytest.approx(expected, rel=0.03, abs=0.03 * np.diag(expected).max())
    assert covariance.log_determinant == pytest.approx(np.linalg.slogdet(whole)[1], abs=0.02 * len(whole))


def test_the_evidence_between_two_laws_is_the_exact_one_of_the_linear_model():
    """Truth: the marginal likelihood N(d; J μ, C + J P⁻¹ Jᵀ) by SciPy; with a flat prior made a wide one."""
    found, exact, training = [], [], cube(with_tail()).training
    fitter, few_colours = with_visible_modes(Fitter([View(model(), CONDITIONS)], training))
    law = WavefrontLaw.of(CONDITIONS.ncpa_law, NOLLS[-1])
    posterior = Posterior(fitter, few_colours, (), Covariance.of(training, fitter.views), law)
    alone = posterior.minimised(posterior.start(), 16)
    whole, columns = dense(posterior.covariance), alone.columns.numpy().T
    data = (alone.stack.mean_e - alone.image).numpy() + columns @ alone.x[0].numpy()
    for scale in (1.0, 2.0):
        changed = law.changed(np.array([np.log(scale), np.log(6.0), 0.0]))
        other = Posterior(fitter, few_colours, (), posterior.covariance, changed)
        variance = np.where(other.prior_precision > 0, 1 / other.prior_precision.clamp_min(1e-30), 1e14)
        marginal = whole + (columns * variance) @ columns.T
        exact.append(multivariate_normal.logpdf(data, columns @ other.prior_mean.numpy(), marginal, True))
        found.append(other.minimised(alone.x, 4).log_evidence)
    assert found[1] - found[0] == pytest.approx(exact[1] - exact[0], abs=0.5)


class Columns:
    """Effects that are named after the columns of a linear model that are theirs."""

    @staticmethod
    def columns_of(label: str) -> list[int]:
        return [int(column) for column in label]


class Known(Linear):
    """A linear model all of whose columns but the last are nothing at zero."""

    def nulls_of(self, label):
        return {column: 0.0 for column in self.fitted.columns_of(label) if column < 4}


def test_the_odds_of_savage_and_dickey_are_those_of_two_evidences():
    """Truth: Gaussian evidences with and without the effect, by hand for a linear model.

    The last column is a place, of which images are linear about where it is, and which what is at nothing
    does not have.
    """
    rng = np.random.default_rng(5)
    design, sigma = rng.standard_normal((60, 5)), np.array([5.0, 2.0, 3.0, 1.0, 2.0])
    data = design[:, :4] @ [1.0, 0.5, 0.0, 0.2] + rng.standard_normal(60)
    covariance = np.linalg.inv(design.T @ design + np.diag(sigma**-2))
    # the place at which the optimum is that about which the model is linear
    fixed = np.eye(5)[4] / sigma[4] ** 2
    place = (covariance @ design.T @ data)[4] / (covariance @ fixed)[4]
    prior_mean = np.array([0, 0, 0, 0, -place])

    def log_evidence(columns: list[int]) -> float:
        some = design[:, columns]
        within = np.eye(60) + some * sigma[columns] ** 2 @ some.T
        return multivariate_normal.logpdf(data, some @ prior_mean[columns], within)

    class Prior:
        """Of the parameters."""

    Prior.prior_mean, Prior.prior_precision = torch.as_tensor(prior_mean), torch.as_tensor(sigma**-2)
    x = covariance @ (design.T @ data + sigma**-2 * prior_mean)
    linear = Known(Columns(), Prior(), torch.as_tensor(covariance), torch.as_tensor(x))
    assert linear.x[4] == pytest.approx(0.0, abs=1e-12)
    everything = log_evidence([0, 1, 2, 3, 4])
    assert linear.log_odds("2") == pytest.approx(everything - log_evidence([0, 1, 3, 4]))
    assert linear.log_odds("24") == pytest.approx(everything - log_evidence([0, 1, 3]))
    less = linear.without("24")
    assert less.log_odds("13") == pytest.approx(log_evidence([0, 1, 3]) - log_evidence([0]))
    assert less.x[2] == pytest.approx(0.0, abs=1e-12)


def task_of(effects, sky_e: float = 0.0) -> Task:
    """The search in frames with some effects."""
    data = cube(with_tail(effects) + sky_e)
    fitter = Fitter([View(model(), CONDITIONS)], data.training)
    moments = Moments.of([Exposures(data.training.parts[0].frames, CONDITIONS)])
    return Task(data, fitter, moments, OPTIONS, lambda count: None, "photon-limited")


def searched(effects, sky_e: float = 0.0) -> Search:
    """What the search with everything free finds in frames with some effects."""
    task = task_of(effects, sky_e)
    return task.searched_from(fitted(task.cube.training), [])


def second_image(defocus_nm: float, sep_mas: float, pa_deg: float) -> list[FixedEffect]:
    """A ghost, and image motion."""
    ghost, jitter = (CATALOGUE[one].under(CONDITIONS) for one in ("ghost", "tip_tilt_jitter"))
    place = ghost.values_of(flux_ratio=0.03, sep_mas=sep_mas, pa_deg=pa_deg, defocus_nm=defocus_nm)
    return [FixedEffect(ghost, place), FixedEffect(jitter, jitter.values_of(sigma_mas=6.0))]


@pytest.mark.slow
@pytest.mark.parametrize(("effect", "values"), [(BUMP, BUMP_VALUES), (STOP, STOP_VALUES)], ids=lambda one: "")
def test_one_effect_beside_a_tail_of_modes_is_named_with_its_size_and_nothing_else(effect, values):
    search = searched([FixedEffect(effect, values)])
    assert [one.name for one in search.accepted] == [effect.name]
    found = search.final.fitted.values_of(effect.name)
    assert found == pytest.approx(values, rel=0.2, abs=0.05)


@pytest.mark.slow
def test_a_second_image_beside_image_motion_has_the_narrowest_form_that_fits():
    """Before the motion is found, the second image is blurred as much as the star is."""
    search = searched(second_image(0.0, sep_mas=110.0, pa_deg=20.0))
    assert {one.name for one in search.accepted} == {"tip_tilt_jitter", "companion"}


def test_a_wider_form_begins_on_either_side_of_the_focus_and_a_narrower_one_as_it_is():
    (ghost,) = in_other_forms("companion", CONDITIONS, PLACE, wider=True)
    (companion,) = in_other_forms("ghost", CONDITIONS, ghost.values, wider=False)
    half_nm = ghost.base.parameters[3].prior_sigma / 2
    begun = [one.values.tolist() for one in _sides(ghost, len(COMPANION.parameters))]
    assert begun == [[*PLACE, -half_nm, 0.0], [*PLACE, half_nm, 0.0]]
    assert _sides(companion, len(ghost.base.parameters)) == [companion]


@pytest.mark.parametrize(
    ("found", "tried", "best"),
    [
        ((40.0, 20.0), ["one"], "one"),  # it keeps more than the other promises
        ((15.0, 25.0), ["one", "other"], "other"),
        ((5.0, 8.0), ["one", "other"], None),  # neither is worth it
    ],
)
def test_a_second_candidate_is_fitted_where_the_first_falls_short_of_what_it_promises(
    monkeypatch, found, tried, best
):
    def fit(log_evidence: float, *labels: str) -> SimpleNamespace:
        return SimpleNamespace(
            log_evidence=log_evidence,
            fitted=SimpleNamespace(problem=SimpleNamespace(effects=SimpleNamespace(labels=labels))),
        )

    names, fitted = ("one", "other"), []
    odds = dict(zip(names, found, strict=True))

    def joined(task, laplace, score):
        fitted.append(score.name)
        return fit(100.0 + odds[score.name], score.name)

    monkeypatch.setattr(Task, "_joined", joined)
    monkeypatch.setattr(Task, "_in_best_form", lambda task, laplace, label, wider: laplace)
    monkeypatch.setattr(Task, "_settled", lambda task, laplace: laplace)
    scores = [
        SimpleNamespace(name=one, log_odds=promise, inflation=1.0)
        for one, promise in zip(names, (30, 22), strict=True)
    ]
    chosen = Task(*[None] * 4, lambda count: None, "")._best(fit(100.0), scores)
    assert fitted == tried
    assert (None if chosen is None else chosen[0].fitted.problem.effects.labels[0]) == best


@pytest.mark.slow
def test_of_two_sides_of_the_focus_the_likelier_is_taken(monkeypatch):
    """Beside motion that the model lacks, a fit begun on the other side is far from the best."""
    both = second_image(120.0, sep_mas=60.0, pa_deg=200.0)
    task = task_of(both)
    fitter, few_colours = with_visible_modes(task.fitter)
    covariance = Covariance.of(fitter.stack, fitter.views)
    law = WavefrontLaw.of(CONDITIONS.ncpa_law, NOLLS[-1])
    sharp = FixedEffect(COMPANION, both[0].values[:3], [one.name for one in COMPANION.parameters])
    posterior = Posterior(fitter, few_colours, [sharp], covariance, law)
    laplace = posterior.minimised(posterior.start(), 16)

    whole, alone = task._in_best_form(laplace, "companion", wider=True), []
    for side in (0, 1):
        one_side = lambda form, known, side=side: [_sides(form, known)[side]]  # noqa: E731
        monkeypatch.setattr("irlos_pipe.diagnosis.search._sides", one_side)
        alone.append(task._in_best_form(laplace, "companion", wider=True).log_evidence)
    assert abs(alone[0] - alone[1]) > 25
    assert whole.log_evidence == pytest.approx(max(alone), abs=1.0)


@pytest.mark.slow
def test_an_ao_residual_that_was_missing_is_named_and_a_faint_second_image_last_however_much_it_explains():
    """To the absence of the residual no model is linear. Any camera makes a second image of 0.45 %."""
    names = ("seeing_halo", "background_gradient", "companion")
    halo, gradient, companion = (CATALOGUE[one].under(CONDITIONS) for one in names)
    values = [one.start for one in halo.parameters]
    slope, place = gradient.values_of(e_per_pixel=1.0, angle_deg=30.0), (0.0045, *PLACE[1:])
    pairs = zip((halo, gradient, companion), (values, slope, place), strict=True)
    search = searched([FixedEffect(*one) for one in pairs], sky_e=30.0)
    assert [one.name for one in search.accepted] == [*names]
    assert search.accepted[2].gain > 3 * search.accepted[1].gain
    assert search.accepted[2].values == pytest.approx(place, rel=0.1)
    found = halo.describe(search.final.fitted.values_of("seeing_halo"))
    assert found["wfe_nm"] == pytest.approx(halo.describe(np.array(values))["wfe_nm"], rel=0.1)


@pytest.mark.slow
def test_beside_a_tail_of_modes_nothing_is_named_where_nothing_is_and_errors_know_of_it():
    search = searched([])
    assert search.accepted == []
    final = search.final.fitted
    sigma = final.solution.covariance[0].diagonal()[: len(NOLLS)].sqrt().numpy()
    error = final.modes_nm - [TRUE_NM.get(noll, 0.0) for noll in NOLLS]
    assert 0.4 < np.sqrt(np.mean((error / sigma)[2:] ** 2)) < 1.7
