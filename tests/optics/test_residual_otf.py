"""Images that move with the coma of the AO residual. Truth: finite differences."""

from __future__ import annotations

import pytest
import torch
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
    draw = torch.randn(2, len(NOLLS), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return 40 * draw


def difference(images, at: torch.Tensor, index: int, step: float) -> torch.Tensor:
    move = torch.zeros(at.shape[-1], dtype=torch.float64)
    move[index] = step
    return (images(at + move) - images(at - move)) / (2 * step)


def test_the_motion_is_a_part_of_the_image_that_none_of_the_other_factors_has(model, effects, modes):
    optics = effects(RESIDUAL)
    moving, still = (model.images(modes, one) for one in (optics, optics._replace(by_mode=())))
    assert float((moving - still).norm() / still.norm()) > 0.003


def test_derivatives_by_residual_and_modes_are_differences(model, effects, modes):
    images, jacobian = model.images_and_jacobian(modes, effects(RESIDUAL), effects.tangents(RESIDUAL))
    assert images == pytest.approx(model.images(modes, effects(RESIDUAL)), rel=1e-12)
    for index in range(len(NOLLS)):
        slope = difference(lambda at: model.images(at, effects(RESIDUAL)), modes, index, 1e-2)
        assert float((jacobian[:, index] - slope).norm() / slope.norm()) < 1e-6
    for index, step in enumerate(STEPS):
        slope = difference(lambda at: model.images(modes, effects(at)), RESIDUAL, index, step)
        assert float((jacobian[:, len(NOLLS) + index] - slope).norm() / slope.norm()) < 1e-6


def test_the_pullback_is_the_gradient_of_a_weighted_sum(model, effects, modes):
    images, pullback = model.images_and_pullback(modes, effects(RESIDUAL))
    factors = torch.randn(images.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    gradient = pullback(factors)
    for index in range(len(NOLLS)):
        slope = difference(lambda at: model.images(at, effects(RESIDUAL)), modes, index, 1e-2)
        exact = (slope * factors).sum((1, 2))
        assert gradient[:, index] == pytest.approx(exact, rel=1e-5, abs=1e-9)
