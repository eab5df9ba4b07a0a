"""An effect with some or all of its parameters held at known values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from irlos_pipe.effects.base import Effect, Parameter


class Pinned:
    """`effect` with every parameter at `values`, except those named in `free`, which start there.

    This is how parameters estimated by one stage are handed on to the next.
    """

    def __init__(self, effect: Effect, values: Sequence[float], free: Sequence[str] = ()):
        self.effect = effect
        self.name, self.place, self.order = effect.name, effect.place, effect.order
        self.instrumental, self.aberration = effect.instrumental, effect.aberration
        self.values = np.array(values, float)
        self.free = [i for i, p in enumerate(effect.parameters) if p.name in free]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Those left free."""
        return tuple(replace(self.effect.parameters[i], start=float(self.values[i])) for i in self.free)

    @property
    def null_values(self) -> list[float]:
        """See `Effect.null_values`."""
        return [p.start if p.null is None else p.null for p in self.parameters]

    @property
    def bare(self) -> Effect:
        """See `Effect.bare`."""
        return self.effect

    def all_values(self, values: Sequence[float]) -> torch.Tensor:
        """See `Effect.all_values`."""
        full = torch.as_tensor(self.values, dtype=torch.float64)
        if not self.free:
            return full
        place = torch.as_tensor(np.eye(len(self.values))[self.free])
        held = torch.as_tensor(np.isin(np.arange(len(self.values)), self.free, invert=True))
        return full * held + torch.as_tensor(values, dtype=torch.float64) @ place

    def apply(self, values: torch.Tensor, *light: Any) -> Any:
        """See the `apply` of the effect's place."""
        return self.effect.apply(self.all_values(values), *light)

    def slopes(self, values: torch.Tensor, field, grid, wanted: Sequence[int]) -> list[torch.Tensor]:
        """See `PupilEffect.slopes`."""
        return self.effect.slopes(self.all_values(values), field, grid, [self.free[i] for i in wanted])

    def opd_nm(self, values: torch.Tensor, grid) -> torch.Tensor | None:
        """See `PupilEffect.opd_nm`."""
        return self.effect.opd_nm(self.all_values(values), grid)

    def describe(self, values: Sequence[float]) -> dict[str, Any]:
        """See `Effect.describe`."""
        return self.effect.describe(self.all_values(values).numpy())


def expected(effects: Sequence[Effect | Pinned]) -> list[Effect | Pinned]:
    """The same effects held at what is to be expected: usual ones at their start, others absent."""
    return [_expected(effect) for effect in effects]


def _expected(effect: Effect | Pinned) -> Effect | Pinned:
    if not effect.parameters:
        return effect
    if isinstance(effect, Pinned):
        return Pinned(effect.effect, effect.values)
    return Pinned(effect, [p.start for p in effect.parameters] if effect.usual else effect.null_values)
