"""Errors of effects beside the modes; truth: scatter over recordings drawn from the model (same code)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.optics_cases import DIVERSITY, NARROW_H, PRIOR, READ_NOISE, draw_frames, everything, settings

from irlos_pipe.effects import EffectSet, FixedEffect, TipTiltJitter
from irlos_pipe.effects.companion import Companion
from irlos_pipe.effects.effect_set import fixed_optics
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_errors import public_errors
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.optics.psf import PsfModel

WINDOW, SIGMA_MAS, FRAMES, RECORDINGS = (24, 24), 7.0, 24, 10


def recording(seed: int) -> Frames:
    model = PsfModel(settings(WINDOW, NARROW_H, DIVERSITY), (4,), dtype=torch.float64)
    optics = fixed_optics([FixedEffect(TipTiltJitter(), [SIGMA_MAS**2])], model.grids)
    image = model.images(torch.tensor([[30.0]], dtype=torch.float64), optics)[0].numpy()
    images = draw_frames(2e5 * image, FRAMES, seed)
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
