"""Parts of a diagnosis, on frames drawn from the model itself (same code) unless a test says otherwise.

Truth: scipy's distributions, Monte Carlo, finite differences, and what was put into the frames.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.diagnose_frames import (
    CASE,
    CONDITIONS,
    FRAMES,
    NOLLS,
    TRUE_NM,
    cube,
    fitted,
    frames,
    image,
    optimum,
)
from helpers.optics_cases import READ_NOISE
from scipy import stats

from irlos_pipe.diagnosis.acceptance import HeldOutEvaluation, preference
from irlos_pipe.diagnosis.checks import (
    judge_noise,
    measure_drift,
    motion_ratio,
    outstanding_pixels,
)
from irlos_pipe.diagnosis.conclude import screened_step
from irlos_pipe.diagnosis.cube import without_blocks_of_time
from irlos_pipe.diagnosis.effect_sizes import _at_least, detectable, determined
from irlos_pipe.diagnosis.fitting import most_plausible
from irlos_pipe.diagnosis.null_model import SURE, gaussian_sigma
from irlos_pipe.diagnosis.records import Gap
from irlos_pipe.diagnosis.scores import (
    Family,
    copies_in,
    score_family,
    whitened_shapes,
)
from irlos_pipe.diagnosis.view import Screened
from irlos_pipe.effects import Parameter, TipTiltJitter
from irlos_pipe.effects.companion import Companion
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.motion import Vibration
from irlos_pipe.effects.public_values import public_sigma
from irlos_pipe.effects.pupil_places import PhaseBump
from irlos_pipe.effects.pupil_steps import LowWindEffect
from irlos_pipe.effects.redrawn_pupil import PupilMisregistration
from irlos_pipe.frames.noise import NoiseModel

# -- frames ------------------------------------------------------------------------------------


def test_held_out_frames_lie_between_the_others_and_are_no_part_of_them():
    parts = without_blocks_of_time(frames(image()), 0.25)
    training, held = parts.training.parts[0].when, parts.held_out.parts[0].when
    assert not set(training) & set(held)
    assert len(held) == pytest.approx(0.25 * FRAMES, abs=2)
    assert training.min() < held.min() < held.max() < training.max()


def test_poisson_frames_keep_to_the_noise_model():
    verdict = judge_noise(without_blocks_of_time(frames(image())).training.parts[0])
    assert verdict.kind == "photon-limited"
    assert verdict.holds
    assert verdict.bright_ratio == pytest.approx(1, abs=0.1)


def test_a_wrong_gain_shows_in_the_noise_verdict():
    """Variance twice the mean in every pixel, floor included."""
    verdict = judge_noise(
        without_blocks_of_time(frames(image(), noise=NoiseModel(2.0, 2.0))).training.parts[0]
    )
    assert not verdict.holds or verdict.kind == "speckle-limited"


def test_speckles_that_change_make_a_cube_speckle_limited():
    rng = np.random.default_rng(2)
    moving = [image({**TRUE_NM, 7: TRUE_NM[7] + 60 * rng.standard_normal()}) for _ in range(FRAMES)]
    assert (
        judge_noise(without_blocks_of_time(frames(np.array(moving))).training.parts[0]).kind
        == "speckle-limited"
    )


# -- statistics --------------------------------------------------------------------------------


def test_significance_is_that_of_a_normal_deviate_of_the_same_tail():
    assert gaussian_sigma(30.0, 4, np.inf) == pytest.approx(stats.norm.isf(stats.chi2.sf(30.0, 4)), rel=1e-6)
    tail = stats.f.sf(30.0 * 36 / (4 * 39), 4, 36)
    assert gaussian_sigma(30.0, 4, 40.0, trials=3) == pytest.approx(stats.norm.isf(3 * tail), rel=1e-6)


@pytest.mark.slow
def test_what_noise_leaves_of_chi2_is_expected_from_the_frames():
    """Monte Carlo: without anything missing the excess scatters about zero by its σ."""
    deviates = [optimum(cube(image(), seed).training).excess.significance for seed in range(12)]
    assert abs(np.mean(deviates)) < 3 / np.sqrt(12)
    assert 0.5 < np.std(deviates) < 1.6


@pytest.mark.slow
def test_the_noise_of_the_dark_is_no_excess_and_no_significance():
    """Monte Carlo: a pattern as noisy as the mean of the frames, of which the noise model knows."""
    dark_e2 = 4.0
    found = []
    for seed in range(6):
        pattern_e = np.sqrt(dark_e2) * np.random.default_rng(100 + seed).standard_normal(CASE.window)
        exposed = frames(image() + pattern_e + 20.0, seed)
        known = replace(exposed, noise=replace(READ_NOISE, shared_e2=dark_e2))
        found.append([optimum(without_blocks_of_time(one).training) for one in (known, exposed)])
    known, unknown = np.array([[one.excess.significance for one in pair] for pair in found]).T
    assert abs(known.mean()) < 1.5
    assert abs(known).max() < 4
    assert unknown.min() > 5
    shape = torch.zeros(CASE.window, dtype=torch.float64)
    shape[3:9, 4:8] = 1.0
    shape = shape.flatten()[:, None]
    deviates = [
        float(one.projection(shape) / one.stack.covariance_of(one.project(shape))[0, 0] ** 0.5)
        for one, _ in found
    ]
    assert np.abs(deviates).max() < 4


@pytest.mark.parametrize(("lower_by", "chosen"), [(20.0, 0), (20_000.0, 1)])
def test_rounding_of_a_large_chi2_decides_nothing_between_twins_but_a_better_fit_does(lower_by, chosen):
    unit = 100.0  # χ²/ν of the better
    assert most_plausible([100_000.0, 100_000.0 - lower_by], [2.0, 12.0], lambda *_: unit) == chosen


@pytest.mark.parametrize(("scatter", "chosen"), [(1.0, 88.0), (4.0, 100.0)])
def test_of_twins_whose_images_differ_less_than_the_speckles_scatter_the_smaller_aberration_wins(
    scatter, chosen
):
    """χ² of a mean image counts by the scatter of the frames along the difference of two models."""
    chi2, penalty = [100.0, 88.0], [2.0, 10.0]
    for order in ([0, 1], [1, 0]):
        several = [chi2[i] for i in order], [penalty[i] for i in order]
        assert several[0][most_plausible(*several, lambda *_: scatter)] == chosen


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "step"), [(PhaseBump, 29), (Vibration, 3)])
def test_candidates_tried_together_beside_frozen_effects_have_the_derivatives_that_each_has_alone(kind, step):
    at_rest = optimum(cube(image()).training, [PupilMisregistration()])
    part, x = at_rest.fitted.problem.parts[0], at_rest.fitted.x
    held = part.model.effects.held(at_rest.fitted.effect_values).effects
    tried = kind().candidates(CASE.window, 9.7)[::step]
    at = x[:, part.layout.modes], x[:, -2], x[:, -1]
    for one, shape in zip(tried, whitened_shapes(at_rest, tried), strict=True):
        null = torch.tensor(one.null_values, dtype=torch.float64)
        columns = ImageModel(part.model.psf, [*held, one]).predict_and_jacobian(*at, null)[1]
        alone = columns[0, -3].flatten() * at_rest.root  # before flux and background
        assert shape[:, 0].numpy() == pytest.approx(alone.numpy(), abs=1e-9 * float(alone.norm()))


# -- single effects ----------------------------------------------------------------------------


def test_the_quick_search_finds_the_companion_that_the_exact_score_prefers():
    place = (-58.2, 77.6)  # whole pixels
    stack = cube(image(effect=Companion(), values=[0.02, *place])).training
    best = copies_in(optimum(stack), Companion.under(CONDITIONS))[0]
    assert best.values[1:] == pytest.approx(place, abs=9.8)


@pytest.mark.slow
def test_a_linear_size_is_near_the_true_one_when_the_effect_is_weak():
    stack = cube(image(effect=TipTiltJitter(), values=[4.0])).training
    score = score_family(optimum(stack), Family((TipTiltJitter(),)))
    assert score.sizes[0] == pytest.approx(4.0, abs=5 * score.smallest[0])
    assert score.significance > 3


@pytest.mark.slow
def test_the_smallest_detectable_size_is_nearly_always_detected():
    """Monte Carlo over 10 cubes: beyond the odds of a name by the 1.645 σ of 95 %, ±3 errors of the mean."""
    jitter = Family((TipTiltJitter(),))
    null = score_family(optimum(cube(image(), 3).training), jitter)
    size = detectable(null)["sigma_mas"]
    stacks = [cube(image(effect=TipTiltJitter(), values=[size**2]), seed).training for seed in range(10)]
    found = [score_family(optimum(stack), jitter) for stack in stacks]
    assert sum(one.log_odds > SURE for one in found) >= 8
    pulls = [one.gain**0.5 for one in found]
    width = TipTiltJitter().parameters[0].proper_prior[1] / null.smallest[0]
    assert null.trials == 1
    expected = (2 * SURE + np.log(1 + width**2)) ** 0.5 + 1.645
    assert np.mean(pulls) == pytest.approx(expected, abs=3 / np.sqrt(10))


def test_a_hot_pixel_stands_out_and_nothing_else():
    mean = image()
    mean[5, 22] += 60
    assert outstanding_pixels(optimum(cube(mean).training)) == [(5, 22)]
    assert outstanding_pixels(optimum(cube(image()).training)) == []


def test_a_masked_pixel_is_named_if_it_showed_something_else_than_the_star():
    at_rest = optimum(cube(image()).training)
    star_e = float(image()[5, 22])
    gap = Gap(0.01, 0.01, 0.01)
    right, hot = Screened(5, 22, star_e), Screened(5, 22, star_e + 60)
    assert screened_step([right], at_rest, FRAMES, gap) is None
    step = screened_step([right, hot], at_rest, FRAMES, gap)
    assert (step.name, step.public) == ("bad_pixels", {"pixels": [[5, 22]]})
    assert step.significance > 5
    light_e = float(at_rest.fitted.image_e.sum())
    assert step.gap.before == pytest.approx((0.01 * light_e + 60) / (light_e + star_e + 60), rel=1e-2)


def test_a_drift_is_measured_with_its_sign():
    true = {5: 25.0, 8: -18.0}
    course = np.linspace(-0.5, 0.5, FRAMES)
    mean = np.array([image({n: TRUE_NM[n] + true.get(n, 0.0) * t for n in NOLLS}) for t in course])
    stack = cube(mean).training
    drift = measure_drift(stack, fitted(stack), sure=5.0)
    expected = np.array([true.get(noll, 0.0) for noll in drift.nolls])
    assert drift.significance > 5
    assert np.max(np.abs((drift.change_nm - expected) / drift.sigma_nm)) < 4.5


def test_a_drift_beyond_the_range_of_one_linear_step_keeps_its_size():
    course = np.linspace(-0.5, 0.5, FRAMES)
    mean = np.array([image({n: TRUE_NM[n] + (60.0 * t if n == 5 else 0.0) for n in NOLLS}) for t in course])
    stack = cube(30 * mean).training  # bright: the linear step alone is some 0.6 % short, ten times the noise
    drift = measure_drift(stack, fitted(stack), sure=5.0)
    assert drift.change_nm[drift.nolls.index(5)] == pytest.approx(60.0, rel=2e-3)


@pytest.mark.slow
def test_a_steady_wavefront_shows_no_drift():
    stack = cube(image(), 8).training
    assert measure_drift(stack, fitted(stack), sure=5.0).significance < 4


def test_images_that_move_from_frame_to_frame_are_distinguished_from_those_that_do_not():
    rng = np.random.default_rng(6)
    moving = np.array([image({**TRUE_NM, 2: TRUE_NM[2] + 8 * rng.standard_normal()}) for _ in range(FRAMES)])
    still, shaken = (cube(mean).training for mean in (image(), moving))
    assert motion_ratio(still, fitted(still)) == pytest.approx(1, abs=0.6)
    assert motion_ratio(shaken, fitted(shaken)) > 3


@pytest.mark.slow
def test_the_held_out_frames_prefer_the_true_model_and_its_gap_is_that_of_noise():
    parts = cube(image(effect=Vibration(), values=[64.0, 0.6]))
    without, with_it = (fitted(parts.training, some) for some in ([], [Vibration(start_angle_deg=30.0)]))
    assert preference(parts.held_out, with_it, without) > 3
    judge = HeldOutEvaluation(parts.held_out, with_it)
    assert judge.gap == pytest.approx(judge.floor, rel=0.1)
    assert judge.gap < HeldOutEvaluation(parts.held_out, without).gap


def test_directions_that_only_the_prior_holds_are_no_part_of_an_effects_error():
    """Two parameters with a prior of 300 whose difference alone is measured, to ±2: by hand ±1 each."""
    prior = np.eye(2) / 300.0**2
    measured = np.outer([1, -1], [1, -1]) / 2.0**2
    parameters = 2 * (Parameter("piston", "nm", 0.0, prior_sigma=300.0),)
    own = determined(parameters, np.linalg.inv(measured + prior))
    assert np.sqrt(np.diag(own)) == pytest.approx([1.0, 1.0], rel=1e-3)


def test_a_number_that_only_its_prior_holds_has_the_width_of_that_as_its_error():
    """By itself and beside one that the data determine; by hand."""
    scale, turn = (Parameter(name, "", 0.0, prior_sigma=0.02) for name in ("fraction", "turn"))
    for more, sigma in (((), [0.018]), ((turn,), [0.018, 0.001])):
        own = determined((scale, *more), np.diag(sigma) ** 2)
        assert np.sqrt(np.diag(own)) == pytest.approx(sigma)


def test_motion_from_frame_to_frame_does_not_raise_the_floor_of_the_gap():
    """Monte Carlo: frames that differ by a tilt, which is refitted, and by photons."""
    rng = np.random.default_rng(9)
    still = image()
    moved = np.array([image({**TRUE_NM, 2: TRUE_NM[2] + 8 * rng.standard_normal()}) for _ in range(FRAMES)])
    calm, shaken = (without_blocks_of_time(frames(mean)).limited_by(False) for mean in (still, moved))
    floors = [HeldOutEvaluation(one.held_out, fitted(one.training)).floor for one in (calm, shaken)]
    photons = HeldOutEvaluation(cube(still).held_out, fitted(cube(still).training)).floor
    assert floors == pytest.approx([photons, photons], rel=0.15)


def test_errors_of_public_values_follow_from_those_of_the_solver():
    """Monte Carlo of 20000 draws of the solver's parameters."""
    companion, values = Companion(), np.array([0.03, 60.0, -45.0])
    covariance = np.array([[1e-6, 2e-4, 0], [2e-4, 0.3, 0.1], [0, 0.1, 0.5]])
    drawn = np.random.default_rng(0).multivariate_normal(values, covariance, 20000)
    public = [companion.describe(one) for one in drawn]
    sigma = public_sigma(companion, values, covariance)
    for key in ("flux_ratio", "sep_mas", "pa_deg"):
        assert sigma[key] == pytest.approx(np.std([one[key] for one in public]), rel=0.03)


@pytest.mark.slow
def test_petals_are_told_as_differences_with_the_errors_of_these():
    """Monte Carlo of 20000 draws in which all petals move together by far more than they differ."""
    effect, rng = LowWindEffect(), np.random.default_rng(3)
    values, own = np.array([70.0, -70, 50, -30, 0, 20, 0, -20, 25, 0, -25, 0]), rng.uniform(1, 3, 12)
    together = np.kron(np.eye(3), np.ones((4, 1)))
    covariance = np.diag(own**2) + 150.0**2 * together @ together.T
    drawn = [effect.shown(one) for one in rng.multivariate_normal(values, covariance, 20000)]
    shown, sigma = effect.shown(values), public_sigma(effect, values, covariance, shown=True)
    assert shown["piston_nm_from_mean"] == pytest.approx([65.0, -75.0, 45.0, -35.0])
    for key in shown:
        scatter = np.std([one[key] for one in drawn], axis=0)
        assert sigma[key] == pytest.approx(scatter, rel=0.03), key
        assert np.all(scatter < 4)


def test_parameters_in_which_the_frames_do_not_scatter_have_the_variance_of_fisher_and_nothing_overflows():
    fisher = np.diag([4.0, 1e200, 9.0, 1e30])
    series = np.random.default_rng(3).standard_normal((3, 50)) * [[4.0], [0.0], [1.0]]
    scatter = np.zeros((4, 4))
    scatter[:3, :3] = np.cov(series)
    scatter[3, 3] = 5e-324
    with np.errstate(all="raise"):
        found = _at_least(fisher, scatter)
    assert np.diag(found) == pytest.approx([scatter[0, 0], 1e200, 9.0, 1e30])
    assert found[0, 2] == pytest.approx(scatter[0, 2] * 3 / np.sqrt(scatter[2, 2]))
    sigma = np.sqrt(np.diag(found))
    assert np.all(np.linalg.eigvalsh(found / np.outer(sigma, sigma)) > 0)
