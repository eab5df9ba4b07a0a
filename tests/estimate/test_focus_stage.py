"""Errors of the focus stage. Truth: the definition, worked out by hand; ramps drawn with known errors."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from irlos_pipe.effects import FixedEffect
from irlos_pipe.effects.focus_stage import FocusStageHysteresis, FocusStageOffset, FocusStageScale
from irlos_pipe.estimate.ramp import fit_focus_stage

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
