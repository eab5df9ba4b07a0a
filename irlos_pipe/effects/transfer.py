"""OTF factors of all effects together, and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from .base import OtfEffect, OtfGrid, Parameter

if TYPE_CHECKING:
    from ..psf import PsfModel


class Transfer:
    """Product of the OTF factors of several effects as a function of one parameter vector.

    Parameters
    ----------
    effects : sequence of OtfEffect
    grid : OtfGrid
    """

    def __init__(self, effects: Sequence[OtfEffect], grid: OtfGrid):
        self.effects, self.grid = tuple(effects), grid

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters of all effects in order."""
        return tuple(parameter for effect in self.effects for parameter in effect.parameters)

    def __call__(self, values: torch.Tensor) -> torch.Tensor:
        """OTF factor, (wavelengths, p, p//2 + 1), float64."""
        exponent, first = 0, 0
        for effect in self.effects:
            last = first + len(effect.parameters)
            exponent = exponent + effect.exponent(values[first:last], self.grid)
            first = last
        return torch.exp(-exponent)

    def derivatives(self, values: torch.Tensor) -> torch.Tensor:
        """Derivative of the factor with respect to every parameter, (parameters, wavelengths, ...)."""
        return torch.func.jacfwd(self)(values).movedim(-1, 0)

    def split(self, values) -> dict[str, np.ndarray]:
        """The parameter vector cut into one piece per effect, by effect name."""
        pieces, first = {}, 0
        for effect in self.effects:
            last = first + len(effect.parameters)
            pieces[effect.name] = np.asarray(values[first:last], float)
            first = last
        return pieces

    def describe(self, values) -> dict[str, dict[str, float]]:
        """Public parameters of every effect, by effect name."""
        pieces = self.split(values)
        return {effect.name: effect.describe(pieces[effect.name]) for effect in self.effects}


def fixed_transfer(effects: Sequence[OtfEffect], model: PsfModel) -> torch.Tensor | None:
    """OTF factors of effects without free parameters, on the model's device; None without effects."""
    if not effects:
        return None
    transfer = Transfer(effects, OtfGrid(model.grid, model.wavelengths_m))
    return transfer(torch.zeros(0, dtype=torch.float64)).to(model.device, model.dtype)
