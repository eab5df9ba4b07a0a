"""Several candidates in the pupil as one effect: the light path up to them is computed once for all."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from irlos_pipe.effects import Effect
from irlos_pipe.effects.base import PupilEffect
from irlos_pipe.optics.grids import PupilGrid


class Bundle(PupilEffect):
    """Candidates at their null values, where each leaves the field as it is.

    Parameters
    ----------
    candidates : sequence of Effect
        Of one family, in the pupil.
    """

    name = "bundle"

    def __init__(self, candidates: Sequence[Effect]):
        self.bundled, self.order = tuple(candidates), candidates[0].order
        self.parameters = tuple(p for one in candidates for p in one.parameters)

    @property
    def null_values(self) -> list[float]:
        """See `Effect.null_values`."""
        return [value for one in self.bundled for value in one.null_values]

    def apply(self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        """See `PupilEffect.apply`."""
        return field

    def slopes(
        self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid, wanted: Sequence[int]
    ) -> list[torch.Tensor]:
        """See `PupilEffect.slopes`."""
        every = [slope for one in self.bundled for slope in _slopes(one, field, grid)]
        return [every[index] for index in wanted]


def _slopes(candidate: Effect, field: torch.Tensor, grid: PupilGrid) -> Sequence[torch.Tensor]:
    null = torch.tensor(candidate.null_values, dtype=torch.float64)
    return candidate.slopes(null, field, grid, range(len(null)))
