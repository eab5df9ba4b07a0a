"""What is held out of a recording: some of its frames, or, where they are too few, some of its pixels.

Fits never see it, and it judges them. Of thousands of frames, means over consecutive ones are as good and
bound memory and time: what a mean image cannot show changes slowly, or averages out.

Of one image or a few frames a part of the pixels is held out. The scatter between frames, which would tell
how speckles that did not average out make a mean image differ from its model, is not seen. The noise model,
and the scatter of as many frames as there are, give the errors of pixels; what a model misfits beyond them is
counted as an error of the model that any further parameter would meet as well: variances grow by χ²/ν. That
is weaker than held-out frames: an error common to all pixels, or to all the time of the exposure, is seen by
neither side.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch

from irlos_pipe.conventions.units import NM, resolution_px
from irlos_pipe.diagnosis.cube import Cube, HeldOutKind, Stack, Stacks
from irlos_pipe.diagnosis.view import Exposures
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.frames.blocks import mean_frame

BLOCKS = 20  # blocks of a cube in time; every fourth is held out
MOST_FRAMES = 512  # frames of a recording; more are averaged, which bounds memory
SEED = 1  # of the choice of pixels, so that a diagnosis can be repeated


class HoldOut(ABC):
    """A way to hold out a part of the data."""

    @abstractmethod
    def split(self, frames: Frames, share: float = 0.25) -> Cube:
        """Hold out a `share` of the data of one recording, whose `frames` are in order of time."""


class HeldOutFrames(HoldOut):
    """Blocks of time that interleave with the others."""

    def split(self, frames: Frames, share: float = 0.25) -> Cube:
        frames = averaged(frames, MOST_FRAMES)
        count = len(frames.images_e)
        blocks_of_time = min(BLOCKS, count // 2)
        every = min(round(1 / share), blocks_of_time)
        held = (np.arange(count) * blocks_of_time // count) % every == every // 2
        when = np.linspace(0, 1, count)

        def part(chosen: np.ndarray) -> Stacks:
            some = replace(frames, images_e=frames.images_e[torch.as_tensor(chosen)])
            return Stacks((Stack.of(some, when[chosen]),))

        return Cube(part(~held), part(held))


@dataclass(frozen=True)
class HeldOutPixels(HoldOut):
    """Squares of pixels."""

    side_px: int  # of a square; about λ/D, which makes squares independent parts of an image

    def split(self, frames: Frames, share: float = 0.25) -> Cube:
        """Of squares of similar brightness the same share, at random."""
        squares = _squares(tuple(frames.good.shape), self.side_px)
        held = torch.as_tensor(_drawn(squares, (frames.mean_e * frames.good).numpy(), share))
        labels = torch.as_tensor(squares).flatten()
        whole = Stack.of(frames, np.linspace(0, 1, len(frames.images_e)))

        def part(chosen: torch.Tensor) -> PixelStacks:
            good = chosen & frames.good
            seen = good.flatten()
            variance = torch.where(seen, whole.variance_e2, torch.inf)
            patches = torch.where(seen, labels, -1)
            some = replace(frames, good=good)
            return PixelStacks((PatchStack(some, whole.when, whole.mean_e, variance, patches=patches),))

        return Cube(part(~held), part(held))


def hold_out_of(recordings: Sequence[Exposures]) -> HoldOut:
    """What to hold out of `recordings` that are diagnosed jointly; the shortest of them decides."""
    if all(one.frames.show_scatter for one in recordings):
        return HeldOutFrames()
    return HeldOutPixels(max(_resolution_px(one) for one in recordings))


def averaged(frames: Frames, most: int) -> Frames:
    """`frames`, or means over as many consecutive ones each, `most` at most; the last few may be left out."""
    each = -(-len(frames.images_e) // most)
    if each == 1:
        return frames
    whole = len(frames.images_e) // each * each
    means = [mean_frame(run.numpy()) for run in frames.images_e[:whole].split(each)]
    noise = frames.noise
    quieter = replace(
        noise, excess_noise_factor=noise.excess_noise_factor / each, floor_e2=noise.floor_e2 / each
    )
    return replace(frames, images_e=torch.as_tensor(np.array(means, np.float32)), noise=quieter)


def _resolution_px(exposures: Exposures) -> int:
    """λ/D of the longest wavelength, rounded [px]."""
    settings = exposures.conditions.settings
    longest_m = max(wavelength_nm for wavelength_nm, _ in settings.spectrum) * NM
    return max(1, round(resolution_px(longest_m, settings.geometry.diameter_m, settings.pixel_scale_mas)))


def _squares(window: tuple[int, ...], side_px: int) -> np.ndarray:
    """Number of the square that each pixel of a `window` belongs to, (rows, columns)."""
    rows, columns = (np.arange(size) // side_px for size in window)
    return rows[:, None] * (columns[-1] + 1) + columns


def _drawn(squares: np.ndarray, image_e: np.ndarray, share: float) -> np.ndarray:
    """Pixels of a `share` of the squares, drawn by lot among squares of similar brightness."""
    order, group = np.argsort(-np.bincount(squares.ravel(), image_e.ravel())), round(1 / share)
    lots = np.random.default_rng(SEED)
    drawn = [lots.choice(order[start : start + group]) for start in range(0, len(order), group)]
    return np.isin(squares, drawn)


@dataclass(frozen=True)
class PatchStack(Stack):
    """Some pixels of one recording."""

    # (pixels,), the patch of each pixel, -1 where it is not used.
    patches: torch.Tensor = field(default_factory=lambda: torch.empty(0, dtype=torch.int64))

    @cached_property
    def independent(self) -> float:
        """Number of patches: pixels of one are too close to be independent."""
        return float(len(self._places[0]))

    def losses(self, image_e: torch.Tensor, basis: torch.Tensor) -> np.ndarray:
        """Half of χ² of every patch, (patches,)."""
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
    """Some pixels of one or several recordings."""

    parts: tuple[PatchStack, ...]
    misfit: float = 1.0  # χ²/ν of the model at hand where it is more than 1, by which variances grow
    held_out: ClassVar[HeldOutKind] = "pixels"
    in_time: ClassVar[bool] = False
    own_refitted: ClassVar[bool] = False

    def covariance_of(self, shapes: torch.Tensor) -> torch.Tensor:
        return self.misfit * shapes.mT @ shapes

    def chance(self, basis: torch.Tensor) -> tuple[float, float]:
        """From known noise alone."""
        expected = float((self.root > 0).sum()) - float((basis**2).sum())
        return expected, (2 * expected) ** 0.5

    def noise_e(self, basis: torch.Tensor) -> torch.Tensor:
        """Known noise."""
        return self.variance_e2.sqrt()

    def against(self, residual: torch.Tensor, parameters: int) -> PixelStacks:
        freedom = max(1, int((self.root > 0).sum()) - parameters)
        return replace(self, misfit=max(1.0, float(residual @ residual) / freedom))

    def limited_by(self, photons: bool) -> PixelStacks:
        """Unchanged: whether photons limit them is not known."""
        return self
