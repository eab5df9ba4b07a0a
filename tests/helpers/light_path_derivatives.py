"""Derivatives of a light path and of a fit against finite differences."""

from collections.abc import Callable, Mapping, Sequence

import pytest
import torch

from irlos_pipe.effects import EffectSet
from irlos_pipe.optics.light_path import LightPath

MODE_STEP_NM = 1e-2


def random_modes(count: int) -> torch.Tensor:
    """Two wavefronts of 40 nm RMS in each of some modes."""
    generator = torch.Generator().manual_seed(3)
    return 40 * torch.randn(2, count, generator=generator, dtype=torch.float64)


def difference(images, at: torch.Tensor, index: int, step: float) -> torch.Tensor:
    """Central difference of `images` by one of the values `at`, (..., values)."""
    move = torch.zeros(at.shape[-1], dtype=torch.float64)
    move[index] = step
    return (images(at + move) - images(at - move)) / (2 * step)


def assert_gradient(
    objective: Callable[[torch.Tensor], torch.Tensor],
    gradient: torch.Tensor,
    x: torch.Tensor,
    steps: Mapping[int, float],
    **tolerance: float,
) -> None:
    """The gradient (fits, parameters) of an objective (fits,) is its slope, a step per parameter."""
    for index, step in steps.items():
        slope = difference(objective, x, index, step).numpy()
        assert gradient[:, index].numpy() == pytest.approx(slope, **tolerance), index


def assert_jacobian(
    model: LightPath,
    effects: EffectSet,
    modes: torch.Tensor,
    values: torch.Tensor,
    steps: Sequence[float],
    tolerance: float = 1e-6,
) -> None:
    """The Jacobian by modes and effect parameters, these with a step each, to a part of every column."""
    images, jacobian = model.images_and_jacobian(modes, effects(values), effects.tangents(values))
    assert images == pytest.approx(model.images(modes, effects(values)), rel=1e-12)
    count = modes.shape[1]
    slopes = [
        *(
            difference(lambda at: model.images(at, effects(values)), modes, i, MODE_STEP_NM)
            for i in range(count)
        ),
        *(difference(lambda at: model.images(modes, effects(at)), values, i, s) for i, s in enumerate(steps)),
    ]
    for column, slope in zip(jacobian.unbind(1), slopes, strict=True):
        assert float((column - slope).norm() / slope.norm()) < tolerance


def assert_pullback(model: LightPath, effects: EffectSet, modes: torch.Tensor, values: torch.Tensor) -> None:
    """The pullback of random factors is the gradient by the modes of the images' sum with them."""
    images, pullback = model.images_and_pullback(modes, effects(values))
    factors = torch.randn(images.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    gradient = pullback(factors)
    for index in range(modes.shape[1]):
        slope = difference(lambda at: model.images(at, effects(values)), modes, index, MODE_STEP_NM)
        assert gradient[:, index] == pytest.approx((slope * factors).sum((1, 2)), rel=1e-5, abs=1e-9)
