"""Summary of a focus ramp, and errors of its frames. Truth: analysis on made-up estimates, drawn noise."""

import numpy as np
import pytest
import torch
from helpers.optics_cases import (
    BAND,
    NARROW_H,
    READ_NOISE,
    RESIDUAL_LAW,
    draw_frames,
    everything,
    settings,
    vector,
)

from irlos_pipe.effects import EffectSet, FixedEffect, SeeingHalo, TipTiltJitter
from irlos_pipe.effects.focus_stage import (
    FocusStageHysteresis,
    FocusStageOffset,
    FocusStageScale,
    travel_direction,
)
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.image_fit import Layout
from irlos_pipe.estimate.lift import (
    FrameErrors,
    excess_scatter_nm,
    image_problem,
    instant_error_nm,
    nominal_frame_chi2,
    smooth,
)
from irlos_pipe.estimate.ramp import fit_focus_stage, summarise
from irlos_pipe.estimate.ramp_fit import SharedFit, fit_shared, ramp_effects
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.grids import Grids
from irlos_pipe.optics.psf import PsfModel

OFFSETS_NM = np.array([-300.0, 300, -200, 200, -100, 100, 0])  # every move reverses the travel


def repeated(values, frames: int = 4) -> np.ndarray:
    return np.repeat(np.asarray(values, float), frames)


def test_a_straight_ramp_gives_back_its_line():
    introduced = repeated(OFFSETS_NM)
    summary = summarise(introduced, 1.03 * introduced - 12.0)
    assert (summary.slope, summary.offset_nm) == pytest.approx((1.03, -12.0))
    assert summary.residual_rms_nm == pytest.approx(0, abs=1e-9)
    # RMS of 0.03 x - 12 over symmetric offsets: the two parts add in squares
    assert summary.rms_nm == pytest.approx(np.hypot(12.0, 0.03 * np.sqrt(np.mean(OFFSETS_NM**2))))


def halves(introduced: np.ndarray) -> np.ndarray:
    """True for the frames of the second half of the recording."""
    return np.arange(len(introduced)) >= len(introduced) // 2


@pytest.mark.parametrize(("hysteresis_nm", "bias_nm"), [(14.0, None), (18.0, 25.0), (-6.0, -40.0)])
def test_hysteresis_and_the_bias_of_a_second_run_are_told_from_slope_and_offset(hysteresis_nm, bias_nm):
    """On a ramp from the outside inwards the direction goes with the sign of the offset."""
    introduced = repeated(OFFSETS_NM)
    second = None if bias_nm is None else halves(introduced)
    bias = travel_direction(introduced) * hysteresis_nm / 2 + (0.0 if second is None else bias_nm * second)
    summary = summarise(introduced, 0.97 * introduced + 4.0 + bias, second)
    assert summary.saw_tooth_nm == pytest.approx(hysteresis_nm)
    assert second is None or summary.part_bias_nm == pytest.approx(bias_nm)


def test_what_looks_the_same_is_not_told_apart():
    """A second run that goes down where the first went up: direction and part are one column."""
    introduced = repeated([0.0, 100, 200, 150, 50])
    direction = travel_direction(introduced)
    summary = summarise(introduced, introduced + 20.0 * (direction < 0), direction < 0)
    assert np.isnan([summary.saw_tooth_nm, summary.part_bias_nm]).all()


@pytest.mark.slow
def test_quoted_errors_are_the_scatter_over_many_ramps():
    rng = np.random.default_rng(2)
    introduced = repeated(OFFSETS_NM)
    ramps = [
        summarise(introduced, introduced + 20 * rng.standard_normal(len(introduced)), halves(introduced))
        for _ in range(800)
    ]
    for value, sigma, true in (
        ("slope", "slope_sigma", 1.0),
        ("saw_tooth_nm", "saw_tooth_sigma_nm", 0.0),
        ("part_bias_nm", "part_bias_sigma_nm", 0.0),
    ):
        values, quoted = (np.array([getattr(ramp, name) for ramp in ramps]) for name in (value, sigma))
        assert np.sqrt(np.mean(quoted**2)) == pytest.approx(values.std(), rel=0.08)
        assert values.mean() == pytest.approx(true, abs=4 * values.std() / np.sqrt(800))


def test_failed_estimates_are_left_out_and_keep_the_direction_of_the_others():
    introduced = repeated(OFFSETS_NM)
    estimated = 0.9 * introduced
    estimated[[0, 5, 13]] = np.nan
    assert summarise(introduced, estimated).slope == pytest.approx(0.9)


@pytest.mark.parametrize(
    "estimated", [[np.nan] * 6 + [1.0, 2.0], [1.0] * 2 + [np.nan] * 6], ids=["two", "one offset"]
)
def test_too_little_for_a_line_is_refused(estimated):
    with pytest.raises(ValueError, match="at least three estimates"):
        summarise(repeated([-100.0, 100.0]), np.array(estimated))


# -- errors of frames ----------------------------------------------------------------------------


OFFSETS = np.repeat(np.arange(-300.0, 301.0, 100.0), 40)


def test_scatter_at_one_offset_is_the_defocus_of_the_ao_residual():
    rng = np.random.default_rng(1)
    estimated = 1.1 * OFFSETS + 30 + rng.normal(0, 4.0, OFFSETS.size) + rng.normal(0, 1.0, OFFSETS.size)
    found = excess_scatter_nm(OFFSETS, estimated, np.ones(OFFSETS.size))
    assert found == pytest.approx(4.0, rel=0.15)  # 273 degrees of freedom: 4 %


def test_errors_that_last_for_an_offset_are_errors_of_frames_all_the_same():
    rng = np.random.default_rng(5)
    lasting = np.repeat(rng.normal(0, 6.0, 400), 3)
    offsets = np.repeat(np.linspace(-300, 300, 400), 3)
    estimated = offsets + lasting + rng.normal(0, 2.5, 1200) + 20
    photon = np.full(1200, 1.5)
    assert instant_error_nm(offsets, estimated, photon) == pytest.approx(np.sqrt(36 + 4), rel=0.1)
    assert excess_scatter_nm(offsets, estimated, photon) == pytest.approx(2.0, rel=0.15)


def test_errors_add_noise_grown_by_the_misfit_residual_and_calibration():
    errors = FrameErrors(instant_nm=4.0, chi2_nu=8.0, nominal_chi2_nu=2.0)
    assert errors.sigma_nm(np.array([1.5]), 12.0)[0] == pytest.approx(np.sqrt(3**2 + 4**2 + 12**2))
    assert FrameErrors(0.0, 0.5, 1.0).growth == FrameErrors(0.0, 5.0, float("nan")).growth == 1.0


def test_what_frames_have_in_common_is_no_part_of_the_nominal_chi2():
    rng = np.random.default_rng(4)
    model = torch.full((60, 20, 20), 100.0)
    misfit = 30 * rng.normal(size=(20, 20))
    images = torch.as_tensor(rng.poisson(100.0, (60, 20, 20)) + misfit)
    good = torch.ones(20, 20, dtype=torch.bool)
    noise = NoiseModel(1.0, 0.0)
    introduced = np.repeat([0.0, 100.0, 200.0], 20)
    assert nominal_frame_chi2(images, model, good, noise, introduced, 0) == pytest.approx(1.0, abs=0.05)
    alone = nominal_frame_chi2(images[:3], model[:3], good, noise, np.array([0.0, 1.0, 2.0]), 0)
    assert np.isnan(alone)


# Effects of LIFT: which are chosen, and how they are fitted to a whole ramp.
# Truth: the effects themselves, whose OTF factors are compared; images drawn from the model with known
# parameters (same code: what is tested is the estimator), and the scatter of the estimates over realisations.


AVAILABLE = (SeeingHalo(BAND, RESIDUAL_LAW, 0.5), TipTiltJitter())
MEASURED = FixedEffect(AVAILABLE[0], AVAILABLE[0].values_of(wfe_nm=150.0))


@pytest.fixture(scope="module")
def grids() -> Grids:
    return PsfModel(settings(16, NARROW_H), (4,)).grids


def factor(effects, grids: Grids) -> torch.Tensor:
    together = EffectSet(effects, grids)
    return together(together.starts).transfer


def test_what_a_calibration_has_measured_is_taken_and_the_rest_is_as_expected(grids):
    chosen = ramp_effects(AVAILABLE, {"seeing_halo": MEASURED})
    truth = factor([MEASURED, TipTiltJitter(7.0)], grids)
    torch.testing.assert_close(factor(chosen, grids), truth)
    assert not any(effect.parameters for effect in chosen)


# -- effects fitted to a whole ramp --------------------------------------------------------------


NOLLS = (2, 3, 4)
DEFOCUS_NM = (-200.0, -100.0, 0.0, 100.0, 200.0)
SIGMA_MAS, FLUX_E = 15.0, 3e5


@pytest.fixture(scope="module")
def model() -> PsfModel:
    return PsfModel(settings(40), NOLLS)


def wavefronts() -> torch.Tensor:
    return torch.cat([vector({2: 20.0, 3: -15.0, 4: nm}, NOLLS) for nm in DEFOCUS_NM])


def joint_fit(model: PsfModel, effects: EffectSet, true: float, seed: int, dark_frames: int = 0) -> SharedFit:
    """Fit of a ramp drawn with the only free parameter of `effects` at `true`; the last frames are dark."""
    optics = effects(torch.tensor([true], dtype=torch.float64))
    means = model.images(wavefronts(), optics).double().clamp_min(0).numpy() * FLUX_E
    frames = torch.cat([draw_frames(mean, 1, seed + i) for i, mean in enumerate(means)])
    frames = torch.cat([frames, torch.zeros(dark_frames, *frames.shape[1:])])
    layout, variance = Layout(model.nolls), READ_NOISE.variance_e2(smooth(frames))
    problem = image_problem(ImageModel(model, effects), layout, frames, variance, everything(frames))
    start_nm = torch.cat([0.8 * wavefronts(), torch.zeros(dark_frames, len(NOLLS))])
    return fit_shared(problem, layout.start(frames.flatten(1), start_nm))


def jitter_fit(model: PsfModel, seed: int, start_mas: float = 7.0, sigma_mas: float = SIGMA_MAS) -> SharedFit:
    return joint_fit(model, EffectSet((TipTiltJitter(start_mas),), model.grids), sigma_mas**2, 10 * seed)


@pytest.mark.slow
def test_the_size_of_the_object_is_recovered_from_a_ramp(model):
    fits = [jitter_fit(model, seed) for seed in range(12)]
    assert {fit.status for fit in fits} == {"converged"}
    values = np.array([fit.values.item() for fit in fits])
    sigma = np.array([fit.covariance.item() ** 0.5 for fit in fits])
    pull = (values - SIGMA_MAS**2) / sigma
    assert abs(pull.mean()) < 1.2
    assert 0.5 < pull.std(ddof=1) < 1.7
    assert np.sqrt(values.mean()) == pytest.approx(SIGMA_MAS, rel=0.01)


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_start(model):
    near = jitter_fit(model, 60)
    for far in (jitter_fit(model, 60, start_mas) for start_mas in (1.0, 30.0)):
        assert far.status == "converged"
        assert abs(far.values - near.values).item() < 0.1 * near.covariance.item() ** 0.5


def test_a_frame_without_light_tells_nothing_and_stops_nothing(model):
    effects = EffectSet((TipTiltJitter(7.0),), model.grids)
    bright, one_dark = (joint_fit(model, effects, SIGMA_MAS**2, seed=90, dark_frames=n) for n in (0, 1))
    assert one_dark.status == "converged"
    assert one_dark.values.item() == pytest.approx(
        bright.values.item(), abs=0.1 * bright.covariance.item() ** 0.5
    )


# Errors of the focus stage. Truth: the definition, worked out by hand; ramps drawn with known errors.


KEYS = [("focus_stage_hysteresis", "nm"), ("focus_stage_offset", "nm"), ("focus_stage_scale", "fraction")]
COMMANDED_NM = np.array([-300.0, 300.0, 300.0, -200.0, 200.0, -100.0])


def introduced(effect, value: float) -> np.ndarray:
    return effect.apply(torch.tensor([value]).double(), torch.as_tensor(COMMANDED_NM), COMMANDED_NM).numpy()


def test_hysteresis_adds_up_and_takes_off_down_and_knows_no_direction_before_the_first_move():
    error = introduced(FocusStageHysteresis(), 20.0) - COMMANDED_NM
    assert error.tolist() == [0, 20, 20, -20, 20, -20]


def ramp(**true: float) -> tuple[np.ndarray, np.ndarray]:
    """A ping-pong ramp of six frames per offset, and estimates with 3 nm scatter of what it introduced."""
    offsets = [-300.0, 300.0, -200.0, 200.0, -100.0, 100.0, 0.0]
    commanded, direction = np.repeat(offsets, 6), np.repeat([0, 1, -1, 1, -1, 1, -1], 6)
    real = commanded * (1 + true.get("scale", 0.0)) + true.get("hysteresis", 0.0) * direction
    return commanded, real + true.get("offset", 0.0) + 3 * np.random.default_rng(5).standard_normal(42)


def test_errors_of_the_stage_are_recovered_from_a_ramp_with_their_errors():
    commanded, estimated = ramp(scale=0.11, hysteresis=20.0, offset=-15.0)
    errors = [FocusStageHysteresis(), FocusStageOffset(), FocusStageScale()]
    found = fit_focus_stage(errors, commanded, estimated)
    values = [found.effects[n][k] for n, k in KEYS]
    sigma = [found.sigma[n][k] for n, k in KEYS]
    assert np.abs((np.array(values) - [20.0, -15.0, 0.11]) / sigma).max() < 3
    assert sigma == pytest.approx([0.5, 0.5, 0.0025], rel=0.4)  # 3 nm/√42; over 200 nm RMS
    assert np.std(estimated - found.introduced_nm) == pytest.approx(3.0, rel=0.3)


def test_known_errors_change_what_is_introduced_and_none_leave_it():
    commanded, estimated = ramp()
    known = fit_focus_stage([FixedEffect(FocusStageScale(), [0.1])], commanded, estimated)
    assert known.introduced_nm == pytest.approx(1.1 * commanded)
    assert (known.effects, known.sigma) == ({"focus_stage_scale": {"fraction": 0.1}}, {})
    assert np.array_equal(fit_focus_stage([], commanded, estimated).introduced_nm, commanded)


def test_errors_that_the_ramp_cannot_tell_apart_are_refused():
    commanded, estimated = ramp()
    with pytest.raises(ValueError, match="does not determine focus_stage_hysteresis"):
        fit_focus_stage([FocusStageHysteresis()], np.zeros(6), np.ones(6))
    twice = [FocusStageOffset(), FocusStageOffset(above_nm=-1000.0)]
    with pytest.raises(ValueError, match="does not determine focus_stage_offset"):
        fit_focus_stage(twice, commanded, estimated)
