"""Images that move with the coma of the AO residual. Truth: finite differences."""

from __future__ import annotations

import pytest
import torch
from helpers.light_path_derivatives import assert_jacobian, assert_pullback, random_modes
from helpers.optics_cases import BAND, J_AND_H, RESIDUAL_LAW, settings

from irlos_pipe.effects import EffectSet, SeeingHalo
from irlos_pipe.optics.psf import PsfModel

NOLLS = (2, 4, 5, 7, 8, 9, 22)
RESIDUAL = torch.tensor([120.0**2, 2.5, 0.6, -0.3, 0.2, 0.1, 60.0**2], dtype=torch.float64)
STEPS = (1.0, *[1e-4] * 5, 1.0)


@pytest.fixture(scope="module")
def model() -> PsfModel:
    return PsfModel(settings(32, J_AND_H[::3], pupil_samples=64), NOLLS, dtype=torch.float64)


@pytest.fixture(scope="module")
def effects(model) -> EffectSet:
    return EffectSet((SeeingHalo(BAND, RESIDUAL_LAW, 0.8, measured=False),), model.grids)


@pytest.fixture(scope="module")
def modes() -> torch.Tensor:
    return random_modes(len(NOLLS))


def test_the_motion_is_a_part_of_the_image_that_none_of_the_other_factors_has(model, effects, modes):
    optics = effects(RESIDUAL)
    moving, still = (model.images(modes, one) for one in (optics, optics._replace(by_mode=())))
    assert float((moving - still).norm() / still.norm()) > 0.003


def test_derivatives_by_residual_and_modes_are_differences(model, effects, modes):
    assert_jacobian(model, effects, modes, RESIDUAL, STEPS)


def test_the_pullback_is_the_gradient_of_a_weighted_sum(model, effects, modes):
    assert_pullback(model, effects, modes, RESIDUAL)
