"""Calibration methods on noise-limited frames drawn from the model (same code, on purpose: without
model error every method must find the truth within its errors), the scatter of means against AR(1)
theory, and the twin solution against the symmetry of the pupil. Errors of what the model misfits: behind an
uneven residual against the truth, and errors of the model drawn by Monte Carlo."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases
from helpers.optics_cases import (
    DIVERSITY,
    NARROW_H,
    PRIOR,
    READ_NOISE,
    draw_frames,
    everything,
    ncpa_nm,
    settings,
)
from helpers.reference_psf import reference

from irlos_pipe.effects import EffectSet, FixedEffect, SeeingHalo, TipTiltJitter
from irlos_pipe.effects.companion import Companion
from irlos_pipe.effects.effect_set import fixed_optics
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.seeing_halo import UnevenResidual
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_errors import (
    errors_of,
    errors_of_mean,
    likeliest_size,
    nominal_of,
    public_errors,
    slow_part,
    widening,
)
from irlos_pipe.estimate.calibration_options import METHODS, CalibrationOptions
from irlos_pipe.estimate.cube import (
    Frames,
    autocorrelation_time,
    covariance_of_mean,
    local_mean,
    steadied,
)
from irlos_pipe.estimate.starts import twin_of
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import PsfSettings

NOLLS = tuple(range(2, 16))
FRAMES, FLUX = 12, 3e6


@pytest.fixture(scope="module")
def cube() -> tuple[Frames, np.ndarray]:
    """Frames with 14 modes of aberration, and the coefficients."""
    true = cases.vector(cases.ncpa_nm(4, highest_noll=15, total_nm=100.0), NOLLS)
    image = PsfModel(cases.settings(), NOLLS).images(true)[0].double().numpy() * FLUX
    images = cases.draw_frames(image, FRAMES, seed=5)
    return Frames(images, cases.everything(images), NoiseModel(1.0, 1.0)), true[0].numpy()


@pytest.mark.slow
def test_both_optimisers_reach_the_same_minimum_of_the_paper_s_loss(cube):
    """DIP global: its L1 loss is nearly kinked, and L-BFGS ends where it cannot lower it any more."""
    frames, _ = cube
    some = Frames(frames.images_e[:4], frames.good, frames.noise)
    both = [CalibrationOptions("dip_global", "l1", name, 15, None) for name in ("lm", "lbfgs")]
    lm, lbfgs = (calibrate(some, cases.settings(), options) for options in both)
    assert lm.options.loss == lbfgs.options.loss == "l1"
    assert np.abs(lm.frames_nm - lbfgs.frames_nm).max() < 0.1
    assert np.abs(lm.zernike_nm - lbfgs.zernike_nm).max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 3])
def test_errors_of_one_frame_or_a_few_are_those_of_independent_repetitions(cube, count):
    """Monte Carlo: pulls of many fits to frames of their own, against the truth."""
    frames, true = cube
    starts = range(0, FRAMES - count + 1, count)
    pulls = []
    for start in starts:
        some = Frames(frames.images_e[start : start + count], frames.good, frames.noise)
        result = calibrate(some, cases.settings(), CalibrationOptions(highest_noll=15, prior=cases.PRIOR))
        assert result.errors_from == "noise"
        assert 0.8 < result.chi2_nu < 1.2
        pulls.append((result.zernike_nm - true) / result.sigma_nm)
    # 14 modes of each are nearly independent: the RMS of so many pulls is uncertain by 4 to 7 %.
    assert 0.8 < np.sqrt(np.mean(np.square(pulls))) < 1.2


def test_errors_hold_the_noise_of_the_dark_that_all_frames_share():
    """Monte Carlo: frames enough for their scatter, each cube with a dark of its own."""
    true = cases.vector(cases.ncpa_nm(4, highest_noll=15, total_nm=100.0), NOLLS)
    image = PsfModel(cases.settings(), NOLLS).images(true)[0].double().numpy() * 2e5
    rng, noise, pulls = np.random.default_rng(7), replace(cases.READ_NOISE, shared_e2=25.0), []
    for seed in range(8):
        images = cases.draw_frames(image, 20, seed=seed) + torch.from_numpy(rng.normal(0, 5.0, image.shape))
        frames = Frames(images.float(), cases.everything(images), noise)
        result = calibrate(frames, cases.settings(), CalibrationOptions(highest_noll=15, prior=cases.PRIOR))
        assert (result.errors_from, 0.8 < result.chi2_nu < 1.2) == ("frames", True)
        pulls.append((result.zernike_nm - true[0].numpy()) / result.sigma_nm)
    assert 0.8 < np.sqrt(np.mean(np.square(pulls))) < 1.2


@pytest.mark.parametrize("count", [2, 3, 30])
def test_frames_that_scatter_as_declared_have_a_noise_ratio_of_one_however_few(count):
    images = torch.from_numpy(np.random.default_rng(count).normal(100.0, 2.0, (count, 80, 80)))
    assert Frames(images, cases.everything(images), NoiseModel(0.0, 4.0)).noise_ratio == pytest.approx(
        1, abs=0.04
    )


def test_tip_and_tilt_of_a_star_that_moves_are_those_of_its_mean_place():
    """Frames are steadied to places up to half a pixel away, which is 47 nm here."""
    still = cases.vector(cases.ncpa_nm(4, highest_noll=15, total_nm=100.0), NOLLS)
    moved = still.repeat(24, 1)
    moved[:, :2] += torch.as_tensor(np.random.default_rng(7).normal(0, 60, (24, 2)))  # 6 mas
    images = PsfModel(cases.settings(), NOLLS).images(moved).double() * FLUX
    images = images + images.sqrt() * torch.randn(images.shape, generator=torch.Generator().manual_seed(2))
    at_rest, good, motion = steadied(images.numpy(), np.ones((64, 64), bool), cases.READ_NOISE, 4.3)
    frames = Frames(torch.as_tensor(at_rest), torch.as_tensor(good), cases.READ_NOISE, motion=motion)
    found = calibrate(frames, cases.settings(), CalibrationOptions(highest_noll=15, prior=cases.PRIOR))
    assert np.abs(found.zernike_nm - moved.mean(0).numpy()).max() < 1
    assert np.abs(found.frames_nm[:, :2] - moved[:, :2].numpy()).max() < 3
    assert found.sigma_nm[:2] == pytest.approx(moved[:, :2].std(0) / np.sqrt(24), rel=0.5)


def test_a_centro_symmetric_pupil_gives_the_twin_the_same_image():
    settings = cases.settings(48)
    model = PsfModel(settings, NOLLS, dtype=torch.float64)
    x = cases.vector(cases.ncpa_nm(8, highest_noll=15), NOLLS)
    first, second = model.images(torch.cat([x, twin_of(x, NOLLS, settings.known.total_nm)]))
    assert float((first - second).abs().max() / first.max()) < 1e-9


def test_the_twin_needs_the_larger_aberration_and_loses(cube):
    frames, _ = cube
    options = CalibrationOptions(highest_noll=15, prior=cases.PRIOR, law=cases.PRIOR.law)
    twin = calibrate(frames, cases.settings(), options).twin
    assert twin.preferred == "solution"
    assert twin.evidence > 4 * twin.delta_chi2 > 0  # the law is three times narrower than the prior
    assert twin.distance_nm > 100
    assert twin.twin_rms_nm > twin.rms_nm


@pytest.mark.parametrize("diversity_nm", [0.0, -20.0])
def test_without_diversity_neither_sign_of_the_even_modes_is_preferred(diversity_nm):
    """Drawn from the law: weak diversity leaves odds, a smaller aberration of one of the two is none."""
    true = cases.vector(cases.ncpa_nm(4, highest_noll=15, total_nm=100.0), NOLLS)
    settings = cases.settings(diversity={6: diversity_nm})
    image = PsfModel(settings, NOLLS).images(true)[0].double().numpy() * FLUX
    images = cases.draw_frames(image, 4, seed=6)
    frames = Frames(images, cases.everything(images), NoiseModel(1.0, 1.0))
    options = CalibrationOptions(highest_noll=15, prior=cases.PRIOR, law=cases.PRIOR.law)
    assert calibrate(frames, settings, options).twin.preferred == "undecided"


def test_a_few_frames_of_moving_speckles_have_the_errors_of_their_scatter():
    """Three frames whose modes differ by 20 nm: their mean errs by 12 nm, and three say little of that."""
    rng = np.random.default_rng(7)
    true = np.zeros((3, len(NOLLS)))
    true[:, 2:] = 20 * rng.standard_normal((3, len(NOLLS) - 2))
    mean = PsfModel(cases.settings(), NOLLS).images(torch.as_tensor(true)).double().numpy() * FLUX
    images = torch.cat([cases.draw_frames(one, 1, seed) for seed, one in enumerate(mean)])
    frames = Frames(images, cases.everything(images), NoiseModel(1.0, 1.0))
    options = CalibrationOptions(highest_noll=15, prior=cases.PRIOR)
    result = calibrate(frames, cases.settings(), options)
    assert result.errors_from == "few_frames"
    assert np.median(result.sigma_nm[2:]) > 20
    assert widening(2) == pytest.approx(6.4, abs=0.1)  # t(0.99865; 2) / 3
    assert widening(99) == pytest.approx(1.03, abs=0.01)


def autoregressive(frames: int, phi: float, columns: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    series = np.zeros((frames, columns))
    series[0] = rng.standard_normal(columns) / np.sqrt(1 - phi**2)
    for i in range(1, frames):
        series[i] = phi * series[i - 1] + rng.standard_normal(columns)
    return series


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.8])
def test_the_error_of_a_mean_counts_the_autocorrelation(phi):
    """An AR(1) series has the integrated autocorrelation time (1 + φ)/(1 − φ)."""
    series = autoregressive(2000, phi, 200, seed=1)
    assert np.mean(autocorrelation_time(series)) == pytest.approx((1 + phi) / (1 - phi), rel=0.12)
    quoted = np.sqrt(np.mean(np.diag(covariance_of_mean(series))))
    assert quoted == pytest.approx(series.mean(0).std(), rel=0.15)


@pytest.mark.parametrize("white", [0.3, 1.0])
def test_errors_of_what_a_closed_loop_leaves_are_those_of_its_slow_part(white):
    """Differences of white noise average to nothing; what averages is the part that is white itself."""
    rng = np.random.default_rng(2)
    quoted, means = [], []
    for _ in range(100):
        drawn = rng.standard_normal((101, 30))
        series = np.diff(drawn, axis=0) + white * rng.standard_normal((100, 30))
        quoted.append(slow_part(series) * np.diag(covariance_of_mean(series)))
        means.append(series.mean(axis=0))
    assert np.sqrt(np.mean(quoted)) == pytest.approx(np.std(means), rel=0.15)
    white = rng.standard_normal((200, 100, 30))
    assert np.mean([slow_part(one) == 1.0 for one in white]) > 0.9


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.8])
def test_slow_changes_that_the_autocorrelation_tells_are_not_counted_twice(phi):
    series = [autoregressive(400, phi, 30, seed) for seed in range(100)]
    quoted = [slow_part(one) * np.diag(covariance_of_mean(one)) for one in series]
    means = [one.mean(axis=0) for one in series]
    assert np.sqrt(np.mean(quoted)) == pytest.approx(np.std(means), rel=0.1)


# -- errors of many frames -----------------------------------------------------------------------


UNEVEN = {"edge": 0.15, "side_x": 0.05, "side_y": -0.05}


@pytest.fixture(scope="module")
def behind_a_cone():
    """Frames behind a residual that is stronger at the edge, a fit that does not list it, the modes."""
    true = cases.vector(cases.ncpa_nm(4, highest_noll=15, total_nm=100.0), NOLLS)
    model = PsfModel(cases.settings(40), NOLLS, dtype=torch.float64)
    halo = SeeingHalo(cases.BAND, cases.RESIDUAL_LAW, 0.8)
    uneven = FixedEffect(UnevenResidual(cases.BAND, cases.RESIDUAL_LAW, 0.8), list(UNEVEN.values()))
    image = ImageModel(model, [FixedEffect(halo, halo.null_values), uneven]).predict(
        true, torch.tensor([FLUX]), torch.zeros(1), torch.empty(0)
    )
    images = cases.draw_frames(image[0].numpy(), 40, seed=5)
    frames = Frames(images, cases.everything(images), NoiseModel(1.0, 1.0))
    options = CalibrationOptions(highest_noll=15, prior=cases.PRIOR)
    return frames, calibrate(frames, cases.settings(40), options, [halo]), true[0].numpy()


@pytest.mark.slow
def test_an_uneven_residual_that_the_images_show_is_fitted_and_counts_in_the_errors(behind_a_cone):
    """Of 12 modes; without it they err by more than five times the scatter."""
    _, result, true = behind_a_cone
    error = (result.zernike_nm - true)[2:]
    assert result.effects["uneven_residual"] == pytest.approx(UNEVEN, abs=0.02)
    assert 0.5 < np.linalg.norm(result.sigma_nm[2:]) / np.linalg.norm(error) < 2.0


@pytest.mark.slow
def test_errors_of_the_model_move_the_modes_by_what_is_quoted_for_the_misfit_that_they_leave(
    behind_a_cone,
):
    """Monte Carlo: errors in proportion to the light, smooth over an Airy core, followed to first order."""
    frames, result, _ = behind_a_cone
    problem, solution = result.fit.problem, result.fit.solution
    rng, across_px = np.random.default_rng(3), 1600e-9 / 8.0 / (cases.SCALE_MAS * cases.MAS_RAD)
    apart = np.subtract.outer(np.arange(40), np.arange(40)) / (2.3 * across_px)
    values, vectors = np.linalg.eigh(np.sinc(apart) ** 2)
    root = vectors * np.sqrt(values.clip(0))
    light = local_mean(frames.mean_e, frames.good.double()).numpy()
    drawn = 0.01 * light * (root @ rng.standard_normal((2000, 40, 40)) @ root.T)
    jacobian = problem.predict_and_jacobian(solution.values[:1])[1][0].numpy()
    weight = problem.root_weight[0, 0].numpy() ** 2
    steps = drawn.reshape(2000, -1) * weight @ jacobian.T @ solution.covariance[0].numpy()
    left = (drawn.reshape(2000, -1) - steps @ jacobian)[:40].reshape(40, 40, 40)
    quoted, nominal = [], nominal_of(frames, problem, solution.values[:1])
    for one in torch.as_tensor(left, dtype=torch.float32):
        seen = replace(frames, images_e=frames.images_e + one)
        quoted.append(np.diag(errors_of(seen, result.fit, result.frames_nm, 1.0, nominal)[0]))
    scatter = slow_part(result.frames_nm[:, 2:29]) * np.diag(covariance_of_mean(result.frames_nm))
    model = np.mean(quoted, axis=0) - scatter
    assert np.sqrt(model) == pytest.approx(steps[:, : len(NOLLS)].std(axis=0), rel=0.1)


def test_the_likeliest_size_of_an_error_is_the_true_one_and_by_chance_next_to_nothing():
    """Monte Carlo: 2000 pixels, of which the error reaches a tenth."""
    rng = np.random.default_rng(4)
    noise, shape = torch.as_tensor(rng.uniform(1, 3, 2000)), torch.zeros(2000, dtype=torch.float64)
    shape[:200] = torch.as_tensor(rng.uniform(1, 9, 200))
    for size in (0.0, 0.5):
        drawn = rng.standard_normal((30, 2000)) ** 2 * (noise + size * shape).numpy()
        found = np.mean([likeliest_size(torch.as_tensor(one), noise, shape) for one in drawn])
        assert found == pytest.approx(size, abs=0.03)


# Calibration of frames made by HCIPy (independent code): no model error is shared with the fit.


HIGHEST_NOLL, CALIBRATION_INDEPENDENT_FRAMES, FLUX_E = 21, 16, 2e6
TRUE_NM = ncpa_nm(9, HIGHEST_NOLL, 120.0)


@cache
def independent(window=48, spectrum=NARROW_H) -> tuple[Frames, PsfSettings]:
    """Frames, and the settings that hold for them."""
    case = settings(window, spectrum)
    images = draw_frames(
        reference().spectral_image(TRUE_NM, case) * FLUX_E, CALIBRATION_INDEPENDENT_FRAMES, seed=12
    )
    return Frames(images, everything(images), READ_NOISE), case


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_method_finds_the_aberrations_of_independent_frames(method):
    result = calibrate(*independent(), CalibrationOptions(method, highest_noll=HIGHEST_NOLL))
    error = result.zernike_nm - np.array(list(TRUE_NM.values()))
    assert np.linalg.norm(error) < 0.5
    assert set(result.frame_status) == {"converged"}


@pytest.mark.slow
@pytest.mark.parametrize("window", [51, (40, 57)], ids=str)
def test_odd_and_rectangular_windows_in_two_colours_bring_no_bias_and_a_chi2_of_one(window):
    frames, case = independent(window, ((1560.0, 1.0), (1690.0, 2.0)))
    result = calibrate(frames, case, CalibrationOptions(highest_noll=HIGHEST_NOLL, prior=PRIOR))
    freedom = np.prod(case.window) - HIGHEST_NOLL - 1
    assert result.chi2_nu == pytest.approx(1, abs=4 * np.sqrt(2 / freedom))
    error = result.zernike_nm - np.array(list(TRUE_NM.values()))
    assert np.linalg.norm(error) < 0.4
    assert np.sqrt(np.mean((error / result.sigma_nm) ** 2)) < 1.8


# Errors of effects beside the modes; truth: scatter over recordings drawn from the model (same code).


WINDOW, SIGMA_MAS, EFFECT_ERRORS_FRAMES, RECORDINGS = (24, 24), 7.0, 24, 10


def recording(seed: int) -> Frames:
    model = PsfModel(settings(WINDOW, NARROW_H, DIVERSITY), (4,), dtype=torch.float64)
    optics = fixed_optics([FixedEffect(TipTiltJitter(), [SIGMA_MAS**2])], model.grids)
    image = model.images(torch.tensor([[30.0]], dtype=torch.float64), optics)[0].numpy()
    images = draw_frames(2e5 * image, EFFECT_ERRORS_FRAMES, seed)
    return Frames(images, everything(images), READ_NOISE)


@pytest.mark.slow
def test_the_error_of_the_image_motion_is_its_scatter_over_recordings():
    choice, pulls = CalibrationOptions(highest_noll=6, prior=PRIOR), []
    for seed in range(RECORDINGS):
        found = calibrate(recording(seed), settings(WINDOW), choice, [TipTiltJitter()])
        value, sigma = (one["tip_tilt_jitter"]["sigma_mas"] for one in (found.effects, found.effects_sigma))
        pulls.append((value - SIGMA_MAS) / sigma)
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.7  # 99 % of ten draws


def test_what_is_held_has_no_error_and_what_is_free_its_own():
    held = FixedEffect(Companion(), [0.03, 60.0, 0.0], free=["flux_ratio"])
    effects = EffectSet([FixedEffect(TipTiltJitter(), [36.0]), held], _grids())
    found = public_errors(effects, torch.tensor([0.03], dtype=torch.float64), np.array([[4e-6]]))
    assert [*found] == ["companion"]
    assert found["companion"] == pytest.approx({"flux_ratio": 2e-3, "sep_mas": 0.0, "pa_deg": 0.0}, abs=1e-9)


def _grids():
    return PsfModel(settings(WINDOW), (4,)).grids


def test_the_error_of_a_mean_over_cubes_holds_what_they_differ_by_beyond_their_errors():
    """Monte Carlo: cubes of one wavefront, and of wavefronts that differ; their pointing differs anyhow."""
    rng, own = np.random.default_rng(3), np.diag(np.linspace(1.0, 2.0, 8) ** 2)
    for apart_nm, expected in ((0.0, 1.5**2 / 5), (12.0, (12.0**2 + 1.5**2) / 5)):
        spread = np.array([40.0, 40.0, *[apart_nm] * 6])
        pulls = []
        for _ in range(300):
            cubes = spread * rng.standard_normal((5, 8)) + rng.standard_normal((5, 8)) @ own**0.5
            covariance = errors_of_mean(cubes, [own] * 5)
            pulls.append(cubes.mean(axis=0) / np.sqrt(np.diag(covariance)))
        mean_square = np.square(pulls)[:, 2:].mean() if not apart_nm else np.median(np.square(pulls)[:, 2:])
        assert 0.4 < mean_square < 1.3  # the median of t² with four degrees of freedom is 0.55
        assert np.diag(covariance)[2:].mean() == pytest.approx(expected, rel=0.6)
        assert np.diag(covariance)[:2].min() > 40
