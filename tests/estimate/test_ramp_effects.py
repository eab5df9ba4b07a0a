"""Effects of LIFT: which are chosen, and how they are fitted to a whole ramp.

Truth: the effects themselves, whose OTF factors are compared; images drawn from the model with known
parameters (same code: what is tested is the estimator), and the scatter of the estimates over realisations.
"""

from __future__ import annotations

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
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.image_fit import Layout
from irlos_pipe.estimate.lift import image_problem, smooth
from irlos_pipe.estimate.ramp_fit import SharedFit, fit_shared, ramp_effects
from irlos_pipe.optics.grids import Grids
from irlos_pipe.optics.psf import PsfModel

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
@pytest.mark.parametrize("start_mas", [1.0, 30.0])
def test_the_result_does_not_depend_on_the_start(model, start_mas):
    near, far = jitter_fit(model, 60), jitter_fit(model, 60, start_mas)
    assert far.status == "converged"
    assert abs(far.values - near.values).item() < 0.1 * near.covariance.item() ** 0.5


def test_the_residual_can_be_scaled_on_a_ramp(model):
    halo = SeeingHalo(BAND, RESIDUAL_LAW, 0.5)
    start = [p.start for p in halo.parameters]
    effects = EffectSet((FixedEffect(halo, start, free=("variance_nm2",)),), model.grids)
    true = 1.5 * start[0]
    fit = joint_fit(model, effects, true, seed=80)
    assert fit.status == "converged"
    assert abs(fit.values.item() - true) < 4 * fit.covariance.item() ** 0.5


def test_a_frame_without_light_tells_nothing_and_stops_nothing(model):
    effects = EffectSet((TipTiltJitter(7.0),), model.grids)
    bright, one_dark = (joint_fit(model, effects, SIGMA_MAS**2, seed=90, dark_frames=n) for n in (0, 1))
    assert one_dark.status == "converged"
    assert one_dark.values.item() == pytest.approx(
        bright.values.item(), abs=0.1 * bright.covariance.item() ** 0.5
    )
