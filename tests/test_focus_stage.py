"""Effects of the focus stage. Truth: the definition, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from irlos_pipe.effects.focus_stage import FocusStageHysteresis, FocusStageOffset, FocusStageScale

COMMANDED_NM = np.array([-300.0, 300.0, 300.0, -200.0, 200.0, -100.0])


def introduced(effect, value: float) -> np.ndarray:
    return effect.apply(
        torch.tensor([value]).double(), torch.as_tensor(COMMANDED_NM), COMMANDED_NM
    ).numpy()


def test_hysteresis_adds_up_and_takes_off_down_and_knows_no_direction_before_the_first_move():
    error = introduced(FocusStageHysteresis(), 20.0) - COMMANDED_NM
    assert error.tolist() == [0, 20, 20, -20, 20, -20]


def test_an_offset_concerns_the_whole_ramp_or_a_part():
    assert (introduced(FocusStageOffset(), 15.0) - COMMANDED_NM).tolist() == [15.0] * 6
    part = introduced(FocusStageOffset(above_nm=0.0), 15.0) - COMMANDED_NM
    assert part.tolist() == [0, 15, 15, 0, 15, 0]


def test_a_scale_stretches_the_commanded_offsets():
    assert introduced(FocusStageScale(), 0.11) == pytest.approx(1.11 * COMMANDED_NM)
