"""An effect with some or all of its parameters held at known values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from .base import OtfEffect, OtfGrid


class Pinned:
    """`effect` with every parameter at `values`, except those named in `free`, which start there.

    This is how parameters estimated by one stage are handed on to the next.
    """

    def __init__(self, effect: OtfEffect, values: Sequence[float], free: Sequence[str] = ()):
        self.effect, self.name = effect, effect.name
        self.values = np.asarray(values, float)
        self.free = [i for i, p in enumerate(effect.parameters) if p.name in free]
        self.parameters = tuple(replace(effect.parameters[i], start=float(self.values[i])) for i in self.free)

    def _all(self, values) -> torch.Tensor:
        full = torch.as_tensor(self.values, dtype=torch.float64)
        return full if not self.free else full.index_put((torch.tensor(self.free),), torch.as_tensor(values))

    def exponent(self, values: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """See `OtfEffect.exponent`."""
        return self.effect.exponent(self._all(values), grid)

    def describe(self, values: np.ndarray) -> dict[str, float]:
        """See `OtfEffect.describe`."""
        return self.effect.describe(self._all(values).numpy())


def expected(effects: Sequence[OtfEffect]) -> list[OtfEffect]:
    """The same effects held at the values a fit would start from."""
    return [
        Pinned(effect, [p.start for p in effect.parameters]) if effect.parameters else effect
        for effect in effects
    ]
