"""The frames of a diagnosis: those that fits may see, and those held out to judge them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from irlos_pipe.estimate.cube import Frames, autocorrelation_time, mean_variance_e2
from irlos_pipe.estimate.lift import smooth

BLOCKS = 20  # of a cube in time; every fourth is held out
MIN_FRAMES = 16  # frames without which scatter means nothing
FAINT_SIGMA = 30.0  # signal of the mean over its noise below which a pixel's variance is taken from around it
LEADING = 8  # principal components of a cube that show its autocorrelation


@dataclass(frozen=True)
class Stack:
    """Frames of one part of a recording, brought to the same flux, and their mean.

    Attributes
    ----------
    frames : Frames
    when : ndarray, (frames,)
        Time, 0 at the first and 1 at the last frame of the whole cube.
    mean_e, variance_e2 : tensor, (pixels,)
        Mean image, and its variance from the scatter between frames; infinite for bad pixels.
    photon_limited : bool
        Whether the noise model alone says how uncertain the mean is.
    """

    frames: Frames
    when: np.ndarray
    mean_e: torch.Tensor
    variance_e2: torch.Tensor
    photon_limited: bool = False

    @classmethod
    def of(cls, frames: Frames, when: np.ndarray) -> Stack:
        """Mean and variance of `frames`, taken at the times `when`."""
        good = frames.good.flatten()
        mean = frames.mean_e
        variance = (mean_variance_e2(frames) * _steadied(mean, frames)).flatten()
        return cls(frames, when, mean.flatten(), torch.where(good, variance, torch.inf))

    def __len__(self) -> int:
        return len(self.when)

    @property
    def root(self) -> torch.Tensor:
        """One over the standard errors of the mean image, 0 for bad pixels, (pixels,)."""
        return self.variance_e2**-0.5

    @cached_property
    def deviations(self) -> torch.Tensor:
        """Frames of equal flux minus their mean, over the standard error of the mean, (frames, pixels)."""
        images = self.frames.images_e.double().flatten(1) * self.frames.good.flatten()
        flux = images.sum(1, keepdim=True)
        equal = images * (flux.mean() / flux)
        return (equal - equal.mean(0)) * self.root

    @cached_property
    def independent(self) -> float:
        """Number of independent frames: all, over the autocorrelation time of what varies most."""
        if self.photon_limited:
            return float(len(self))
        left, values, _ = torch.linalg.svd(self.deviations, full_matrices=False)
        leading = (left * values)[:, :LEADING].numpy()
        return len(self) / float(np.median(autocorrelation_time(leading)))


@dataclass(frozen=True)
class Stacks:
    """Frames of one or several recordings, their mean images one after the other.

    Every frame belongs to one recording, of whose mean it is a part; its deviations are zero in the
    pixels of the others, and are scaled so that covariances over all frames are those of all the means.
    """

    parts: tuple[Stack, ...]

    @property
    def root(self) -> torch.Tensor:
        """One over the standard errors of the mean images, 0 for bad pixels, (pixels,)."""
        return self.variance_e2**-0.5

    @property
    def shared(self) -> torch.Tensor:
        """Whitened variance that all frames of a recording have in common, (pixels,): their dark's."""
        return torch.cat([part.frames.noise.shared_e2 * part.root**2 for part in self.parts])

    def covariance_of(self, shapes: torch.Tensor) -> torch.Tensor:
        """Covariance of the scalar products of the whitened mean with `shapes` (pixels, m), (m, m)."""
        scatter = torch.atleast_2d(torch.cov((self.deviations @ shapes).mT)) / self.independent
        return scatter + shapes.mT @ (self.shared[:, None] * shapes)

    def limited_by(self, photons: bool) -> Stacks:
        """Trust the noise model of these frames if `photons` limit them, else their scatter."""
        return Stacks(tuple(replace(part, photon_limited=photons) for part in self.parts))

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    @property
    def photon_limited(self) -> bool:
        """Whether the noise model alone says how uncertain the means are."""
        return all(part.photon_limited for part in self.parts)

    @cached_property
    def mean_e(self) -> torch.Tensor:
        """Mean images, (pixels,)."""
        return torch.cat([part.mean_e for part in self.parts])

    @cached_property
    def variance_e2(self) -> torch.Tensor:
        """Variances of the mean images, (pixels,)."""
        return torch.cat([part.variance_e2 for part in self.parts])

    @cached_property
    def independent(self) -> float:
        """Number of independent frames."""
        return sum(part.independent for part in self.parts)

    @cached_property
    def deviations(self) -> torch.Tensor:
        """Frames minus the mean of their recording, whitened and scaled, (frames, pixels)."""
        if len(self.parts) == 1:
            return self.parts[0].deviations
        every = len(self) * self.independent
        scaled = (one.deviations * (every / (len(one) * one.independent)) ** 0.5 for one in self.parts)
        return torch.block_diag(*scaled)


@dataclass(frozen=True)
class Cube:
    """Training and held-out frames."""

    training: Stacks
    held_out: Stacks

    @classmethod
    def of_all(cls, cubes: Sequence[Cube]) -> Cube:
        """Several recordings as one."""
        pairs = ([c.training for c in cubes], [c.held_out for c in cubes])
        return cls(*(Stacks(tuple(part for one in some for part in one.parts)) for some in pairs))

    def limited_by(self, photons: bool) -> Cube:
        """Trust the noise model of these frames if `photons` limit them, else their scatter."""
        return Cube(self.training.limited_by(photons), self.held_out.limited_by(photons))


def split(frames: Frames, share: float = 0.25) -> Cube:
    """Hold out a share of the frames in blocks of time that interleave with the others.

    Parameters
    ----------
    frames : Frames
        In order of time.
    share : float
        Part of the frames to hold out.

    Raises
    ------
    ValueError
        If there are too few frames.
    """
    count = len(frames.images_e)
    if count < MIN_FRAMES:
        raise ValueError(f"{count} frames: a diagnosis needs at least {MIN_FRAMES}")
    blocks = min(BLOCKS, count // 2)
    every = min(round(1 / share), blocks)
    held = (np.arange(count) * blocks // count) % every == every // 2
    when = np.linspace(0, 1, count)

    def part(chosen: np.ndarray) -> Stacks:
        some = replace(frames, images_e=frames.images_e[torch.as_tensor(chosen)])
        return Stacks((Stack.of(some, when[chosen]),))

    return Cube(part(~held), part(held))


def _steadied(mean_e: torch.Tensor, frames: Frames) -> torch.Tensor:
    """Correction of the variance of faint pixels to that of the running mean of their signal.

    A variance from the very mean that it weighs is large where the noise is positive and small where it
    is negative, which raises the χ² of faint pixels by a few per cent.
    """
    count = len(frames.images_e)
    variance = frames.noise.mean_variance_e2(mean_e, count)
    calm = frames.noise.mean_variance_e2(smooth(mean_e[None])[0], count)
    faint = mean_e < FAINT_SIGMA * variance.sqrt()
    return torch.where(faint, calm / variance, 1.0)
