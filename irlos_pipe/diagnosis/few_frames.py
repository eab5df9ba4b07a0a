"""One image or a few frames, of whose pixels a part is held out.

The scatter between frames, which would tell how speckles that did not average out make a mean image differ
from its model, is not seen. The noise model, and the scatter of as many frames as there are, give the errors
of pixels; what a model misfits beyond them is counted as an error of the model that any further parameter
would meet as well: variances grow by χ²/ν. That is weaker than held-out frames: an error common to all
pixels, or to all the time of the exposure, is seen by neither side.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch

from irlos_pipe.diagnosis.cube import HeldOutKind, Stack, Stacks


@dataclass(frozen=True)
class PatchStack(Stack):
    """Some pixels of one recording.

    Attributes
    ----------
    patches : tensor of int, (pixels,)
        The patch of each pixel, -1 where it is not used.
    """

    patches: torch.Tensor = field(default_factory=lambda: torch.empty(0, dtype=torch.int64))

    @cached_property
    def independent(self) -> float:
        """Number of patches: pixels of one are too close to be independent."""
        return float(len(self._places[0]))

    def losses(self, image_e: torch.Tensor, basis: torch.Tensor) -> np.ndarray:
        """Half of χ² of every patch, (patches,); see `Stack.losses`."""
        residual = torch.where(self.root > 0, self.mean_e - image_e, 0.0) * self.root
        left = residual - basis @ (basis.mT @ residual)
        return 0.5 * self.summed(left**2).numpy()

    def summed(self, values: torch.Tensor) -> torch.Tensor:
        """Sums over the patches of values (pixels,), (patches,)."""
        found, place, used = self._places
        return torch.zeros(len(found), dtype=values.dtype).index_add_(0, place, values[used])

    @cached_property
    def _places(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The patches, the place among them of every pixel used, and which are."""
        used = self.patches >= 0
        return *torch.unique(self.patches[used], return_inverse=True), used


@dataclass(frozen=True)
class PixelStacks(Stacks):
    """Some pixels of one or several recordings.

    Attributes
    ----------
    parts : tuple of PatchStack
    misfit : float
        χ²/ν of the model at hand where it is more than 1, by which variances grow.
    """

    parts: tuple[PatchStack, ...]
    misfit: float = 1.0
    held_out: ClassVar[HeldOutKind] = "pixels"
    in_time: ClassVar[bool] = False
    own_refitted: ClassVar[bool] = False

    def covariance_of(self, shapes: torch.Tensor) -> torch.Tensor:
        """See `Stacks.covariance_of`."""
        return self.misfit * shapes.mT @ shapes

    def chance(self, basis: torch.Tensor) -> tuple[float, float]:
        """See `Stacks.chance`: from known noise alone."""
        expected = float((self.root > 0).sum()) - float((basis**2).sum())
        return expected, (2 * expected) ** 0.5

    def noise_e(self, basis: torch.Tensor) -> torch.Tensor:
        """See `Stacks.noise_e`: known noise."""
        return self.variance_e2.sqrt()

    def against(self, residual: torch.Tensor, parameters: int) -> PixelStacks:
        """See `Stacks.against`."""
        freedom = max(1, int((self.root > 0).sum()) - parameters)
        return replace(self, misfit=max(1.0, float(residual @ residual) / freedom))

    def limited_by(self, photons: bool) -> PixelStacks:
        """See `Stacks.limited_by`: whether photons limit them is not known."""
        return self
