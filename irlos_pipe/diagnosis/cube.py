"""The data of a diagnosis: those that fits may see, and those held out to judge them.

What is held out of a recording are some of its frames or, where these are too few, some of its pixels. The
classes say how uncertain a mean image is, and what its independent parts are. Of thousands of frames, means
over consecutive ones are as good and bound memory and time: what a mean image cannot show changes slowly, or
averages out.

Of one image or a few frames a part of the pixels is held out. The scatter between frames, which would tell
how speckles that did not average out make a mean image differ from its model, is not seen. The noise model,
and the scatter of as many frames as there are, give the errors of pixels; what a model misfits beyond them is
counted as an error of the model that any further parameter would meet as well: variances grow by χ²/ν. That
is weaker than held-out frames: an error common to all pixels, or to all the time of the exposure, is seen by
neither side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
import torch

from irlos_pipe.conventions.units import NM, resolution_px
from irlos_pipe.diagnosis.view import Exposures
from irlos_pipe.estimate.cube import Frames, autocorrelation_time, mean_variance_e2
from irlos_pipe.estimate.lift import smooth
from irlos_pipe.frames.recording import mean_frame

HeldOutKind = Literal["frames", "pixels"]
FAINT_SIGMA = 30.0  # signal of the mean over its noise below which a pixel's variance is taken from around it
LEADING = 8  # principal components of a cube that show its autocorrelation


@dataclass(frozen=True)
class Stack:
    """Frames of one part of a recording, brought to the same flux, and their mean."""

    frames: Frames
    when: np.ndarray  # (frames,), 0 at the first and 1 at the last frame of the whole cube
    mean_e: torch.Tensor  # (pixels,)
    # (pixels,), of the mean, from the scatter between frames; infinite for bad pixels.
    variance_e2: torch.Tensor
    photon_limited: bool = False  # whether the noise model alone says how uncertain the mean is
    # (pixels,), or 0: part that stands for errors of the flat, which all frames share.
    flat_error_e2: torch.Tensor | float = 0.0
    model_error_e2: torch.Tensor | float = 0.0  # (pixels,), or 0: the same of the model
    alike_px: float = 1.0  # pixels that errors of the model change coherently

    @classmethod
    def of(cls, frames: Frames, when: np.ndarray) -> Stack:
        good = frames.good.flatten()
        mean = frames.mean_e
        variance = (mean_variance_e2(frames) * _steadied(mean, frames)).flatten()
        return cls(frames, when, mean.flatten(), torch.where(good, variance, torch.inf))

    def __len__(self) -> int:
        return len(self.when)

    def with_errors(self, flat_rms: float, misfit: float, alike_px: float) -> Stack:
        """The same frames, with what may be wrong in flat and model in their variances.

        The flat has a relative error `flat_rms`, pixel by pixel. For errors of the model, which change so
        many pixels coherently, variances grow by the factor `misfit`: light that a model has in the wrong
        place interferes with the image as speckles do, so its variance follows theirs, or that of photons.
        """
        plain = self.variance_e2 - self.flat_error_e2 - self.model_error_e2
        flat = (flat_rms * self.mean_e) ** 2
        model = torch.where(plain.isfinite(), (misfit - 1) * (plain + flat), 0.0)
        return replace(
            self,
            variance_e2=plain + flat + model,
            flat_error_e2=flat,
            model_error_e2=model,
            alike_px=alike_px,
        )

    def without_model_error(self) -> Stack:
        """The same frames, with noise and errors of the flat only in their variances."""
        return replace(self, variance_e2=self.variance_e2 - self.model_error_e2, model_error_e2=0.0)

    @property
    def shared_e2(self) -> torch.Tensor | float:
        """Variance of smooth shapes that all frames share: of dark, flat and errors of the model [e-²]."""
        return self.frames.noise.shared_e2 + self.flat_error_e2 + self.alike_px * self.model_error_e2

    @property
    def root(self) -> torch.Tensor:
        """One over the standard errors of the mean image, 0 for bad pixels, (pixels,)."""
        return self.variance_e2**-0.5

    @property
    def differences_e(self) -> torch.Tensor:
        """Frames of equal flux minus their mean, (frames, pixels)."""
        images = self.frames.images_e.double().flatten(1) * self.frames.good.flatten()
        flux = images.sum(1, keepdim=True)
        equal = images * (flux.mean() / flux)
        return equal - equal.mean(0)

    @cached_property
    def deviations(self) -> torch.Tensor:
        """The same over the standard error of the mean."""
        return self.differences_e * self.root

    @cached_property
    def independent(self) -> float:
        """Number of independent frames: all, over the autocorrelation time of what varies most."""
        if self.photon_limited:
            return float(len(self))
        left, values, _ = torch.linalg.svd(self.deviations, full_matrices=False)
        leading = (left * values)[:, :LEADING].numpy()
        return len(self) / float(np.median(autocorrelation_time(leading)))

    def losses(self, image_e: torch.Tensor, basis: torch.Tensor) -> np.ndarray:
        """Half of χ² of every frame, (frames,).

        Against `image_e` (pixels,), with what whitened `basis` (pixels, m) can imitate projected out.
        """
        images = self.frames.images_e.double().flatten(1)
        residual = torch.where(self.root > 0, images - image_e, 0.0) * self.root
        left = residual - (residual @ basis) @ basis.mT
        return (0.5 * (left**2).sum(1) / len(self)).numpy()


@dataclass(frozen=True)
class Stacks:
    """Frames of one or several recordings, their mean images one after the other.

    Every frame belongs to one recording, of whose mean it is a part; its deviations are zero in the pixels of
    the others, and are scaled so that covariances over all frames are those of all the means.
    """

    parts: tuple[Stack, ...]
    # Frames, which show what changes with time and have tip, tilt, flux and background of their own, or
    # pixels of the frames that fits see.
    held_out: ClassVar[HeldOutKind] = "frames"

    @property
    def root(self) -> torch.Tensor:
        """One over the standard errors of the mean images, 0 for bad pixels, (pixels,)."""
        return self.variance_e2**-0.5

    @property
    def shared(self) -> torch.Tensor:
        """Whitened variance that all frames of a recording have in common, (pixels,)."""
        return torch.cat([part.shared_e2 * part.root**2 for part in self.parts])

    def covariance_of(self, shapes: torch.Tensor) -> torch.Tensor:
        """Covariance of the scalar products of the whitened mean with `shapes` (pixels, m), (m, m)."""
        scatter = torch.atleast_2d(torch.cov((self.deviations @ shapes).mT)) / self.independent
        return scatter + shapes.mT @ (self.shared[:, None] * shapes)

    def chance(self, basis: torch.Tensor) -> tuple[float, float]:
        """χ² that noise and speckles leave of the means after a fit, and the standard error of that.

        `basis`: whitened derivatives of the fitted parameters (pixels, parameters), orthonormal.
        """
        left = self.deviations - (self.deviations @ basis) @ basis.mT
        gram = left @ left.mT / (len(left) - 1)
        frames, shared = self.independent, self.shared
        expected = float(gram.trace() / frames + shared @ (1 - (basis**2).sum(1)))
        power = ((gram**2).sum() - gram.trace() ** 2 / (len(left) - 1)) / frames**2
        of_pixels = (left**2).sum(0) / (len(left) - 1) / frames
        variance = 2 * float(power + 2 * shared @ of_pixels + shared @ shared)
        return expected, float(max(variance, 2 * expected) ** 0.5)

    def noise_e(self, basis: torch.Tensor) -> torch.Tensor:
        """Standard errors of the means after a fit of `basis` (see `chance`), unbiased, (pixels,).

        The root of a variance that n frames give is too small by 1 / 4 (n - 1) on average.
        """
        freedom = len(self) - 1
        left = self.deviations - (self.deviations @ basis) @ basis.mT
        variance = self.variance_e2 * (left**2).sum(0) / freedom / self.independent
        return variance.sqrt() * (1 + 1 / (4 * freedom))

    def against(self, residual: torch.Tensor, parameters: int) -> Stacks:
        """These data, their errors as a model of so many `parameters` with this whitened `residual` has them.

        The scatter of frames does not depend on any model.
        """
        return self

    def limited_by(self, photons: bool) -> Stacks:
        """Trust the noise model of these frames if `photons` limit them, else their scatter."""
        return replace(self, parts=tuple(replace(part, photon_limited=photons) for part in self.parts))

    def with_errors(self, flat_rms: float, misfit: float = 1.0, alike_px: float = 1.0) -> Stacks:
        parts = tuple(part.with_errors(flat_rms, misfit, alike_px) for part in self.parts)
        return replace(self, parts=parts)

    def without_model_error(self) -> Stacks:
        return replace(self, parts=tuple(part.without_model_error() for part in self.parts))

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    @property
    def photon_limited(self) -> bool:
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
    """Training and held-out data."""

    training: Stacks
    held_out: Stacks

    @classmethod
    def of_all(cls, cubes: Sequence[Cube]) -> Cube:
        """Several recordings, split in the same way, as one."""
        pairs = ([c.training for c in cubes], [c.held_out for c in cubes])
        return cls(*(replace(some[0], parts=tuple(p for one in some for p in one.parts)) for some in pairs))

    @property
    def frames(self) -> tuple[int, int]:
        """Frames that fits see, and those held out."""
        return len(self.training), len(self.held_out) if self.training.held_out == "frames" else 0

    def limited_by(self, photons: bool) -> Cube:
        return Cube(self.training.limited_by(photons), self.held_out.limited_by(photons))


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


BLOCKS = 20  # blocks of a cube in time; every fourth is held out
MOST_FRAMES = 512  # frames of a recording; more are averaged, which bounds memory
SEED = 1  # of the choice of pixels, so that a diagnosis can be repeated


def without_blocks_of_time(frames: Frames, share: float = 0.25) -> Cube:
    """Hold out a `share` of one recording in blocks of time that interleave with the others.

    The `frames` are in order of time.
    """
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


def without_squares(side_px: int, frames: Frames, share: float = 0.25) -> Cube:
    """Hold out squares of pixels: of those of similar brightness the same `share`, at random.

    A side of about λ/D makes squares independent parts of an image.
    """
    # number of the square that each pixel belongs to, (rows, columns)
    rows, columns = (np.arange(size) // side_px for size in frames.good.shape)
    squares = rows[:, None] * (columns[-1] + 1) + columns
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


def cubes_of(recordings: Sequence[Exposures], share: float) -> list[Cube]:
    """Hold out a `share` of `recordings` that are diagnosed jointly; the shortest decides of what.

    Squares of pixels have a side of λ/D of the longest wavelength.
    """
    if all(one.frames.show_scatter for one in recordings):
        return [without_blocks_of_time(one.frames, share) for one in recordings]
    sides_px = []
    for settings in (one.conditions.settings for one in recordings):
        longest_m = max(wavelength_nm for wavelength_nm, _ in settings.spectrum) * NM
        sides_px.append(resolution_px(longest_m, settings.geometry.diameter_m, settings.pixel_scale_mas))
    side_px = max(1, *map(round, sides_px))
    return [without_squares(side_px, one.frames, share) for one in recordings]


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
