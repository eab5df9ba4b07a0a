"""The other side of a displaced stop beside all modes. Truth: the side on which it was when the images were
made, by the model itself (same code: what is tested is where the fit goes)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases

from irlos_pipe.effects import FixedEffect
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.redrawn_pupil import PupilMisregistration
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.cube_fit import CubeFit
from irlos_pipe.estimate.open_fit import Opened, open_basis
from irlos_pipe.estimate.open_sides import likelier_side
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf import PsfModel

NOLLS = tuple(range(2, 12))
STOP = PupilMisregistration()
FREE = [parameter.name for parameter in STOP.parameters]
DISTANCE_M, DIRECTION_RAD = 0.06, -0.6


def opened_from(direction_rad: float) -> Opened:
    """Fit all modes to the image behind a stop, which begins in a direction; a fit of few iterations."""
    psf = PsfModel(cases.settings(), NOLLS, dtype=torch.float64)
    modes_nm = cases.vector(cases.ncpa_nm(4, highest_noll=11, total_nm=60.0), NOLLS)
    made = ImageModel(psf, [FixedEffect(STOP, [DISTANCE_M, DIRECTION_RAD, 0.0])])
    images = cases.draw_frames(psf.images(modes_nm, made.optics)[0].double().numpy() * 3e6, 4, seed=5)
    frames = Frames(images, cases.everything(images), NoiseModel(1.0, 1.0))
    task = CubeFit(frames, psf, CalibrationOptions(highest_noll=11, prior=cases.PRIOR), None, None)
    closed = task.fit([FixedEffect(STOP, [DISTANCE_M, direction_rad, 0.0], FREE)])
    opened = open_basis(*closed[:1], closed[1].values, max_iterations=30)
    assert opened is not None
    return opened


def stop_of(opened: Opened) -> np.ndarray:
    values = opened.solution.values[0, opened.problem.layout.effect_values]
    distance_m, direction_rad, _ = values.tolist()
    return distance_m * np.array([np.cos(direction_rad), np.sin(direction_rad)])


@pytest.fixture(scope="module")
def wrong() -> Opened:
    return opened_from(DIRECTION_RAD + np.pi)


TRUE_M = DISTANCE_M * np.array([np.cos(DIRECTION_RAD), np.sin(DIRECTION_RAD)])


def test_a_fit_on_the_wrong_side_goes_over_to_the_right_one(wrong):
    assert stop_of(wrong) @ TRUE_M <= 0  # on the other side, or at rest
    found = likelier_side(wrong, max_iterations=30)
    assert found.solution.objective[0] < wrong.solution.objective[0]
    assert stop_of(found) == pytest.approx(TRUE_M, abs=0.01)


def test_a_fit_on_the_right_side_stays_there():
    right = opened_from(DIRECTION_RAD)
    assert stop_of(likelier_side(right, max_iterations=30)) == pytest.approx(TRUE_M, abs=0.01)


def test_a_model_without_a_direction_is_left_as_it_is(wrong):
    held = [
        FixedEffect(effect.base, effect.all_values([0.0] * 3))
        for effect in wrong.problem.model.effects.effects
    ]
    model = ImageModel(wrong.problem.model.psf, held)
    bare = Opened(wrong.problem.with_model(model), wrong.solution, wrong.law)
    assert likelier_side(bare, max_iterations=30) is bare
