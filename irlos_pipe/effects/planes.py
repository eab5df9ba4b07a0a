"""One base class of effects per plane of the light path.

Each asks for one method, `apply`, which takes what arrives at the plane and returns it as the effect leaves
it; derivatives come from automatic differentiation of it, unless an effect knows a quicker way.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from irlos_pipe.conventions.late import Tensor
from irlos_pipe.effects.base import Effect
from irlos_pipe.optics.grids import OtfGrid, PupilGrid, Sampling
from irlos_pipe.optics.psf_settings import PsfSettings


class PupilEffect(Effect):
    """Acts on the complex amplitude in the pupil."""

    plane = "pupil"
    order = 1  # after those that change where light passes, which add to the field

    def apply(self, values: Tensor, field: Tensor, grid: PupilGrid) -> Tensor:
        """`field` (wavelengths, n, n) with the effect, which must be linear in it but for what it adds.

        The `values` (parameters,) are those of the solver, `grid` is that of the pupil.
        """
        raise NotImplementedError


class OtfEffect(Effect):
    """Multiplies the OTF by a factor, real or complex."""

    plane = "otf"

    def apply(self, values: Tensor, factor: Tensor, grid: OtfGrid) -> Tensor:
        """`factor`, broadcastable to (wavelengths, p, p//2 + 1), times that of the effect at `values` on
        `grid`.
        """
        raise NotImplementedError


class CopyOfStar(OtfEffect):
    """A further image of the star that has a focus of its own: the OTF factor of its light path.

    There it stands in the place of the effect that has it among its `Effect.further_paths`, and has its
    parameters.
    """

    def defocus_nm(self, values: Tensor) -> Tensor:
        """Noll 4 beyond that of the star, a scalar [nm RMS]."""
        raise NotImplementedError


class SamplingEffect(Effect):
    """Changes wavelengths, their weights, or the pixel scale."""

    plane = "sampling"

    def apply(self, values: Tensor, sampling: Sampling, nominal: Sampling) -> Sampling:
        """`sampling` with the effect at `values`; `nominal` is what the recording is said to have."""
        raise NotImplementedError


class LensEffect(Effect):
    """Changes what introduced defocus is; held in the settings of the light path."""

    plane = "lens"
    found_by = "ramp"

    def __init__(self, numerical_aperture: float = 0.0):
        """Start from the `numerical_aperture`, NA / n, of the beam in which the focus moves."""

    def apply(self, values: Tensor, settings: PsfSettings) -> PsfSettings:
        """`settings` of a light path with the effect at `values`."""
        raise NotImplementedError


class TimeEffect(Effect):
    """Changes the wavefront during the recording."""

    plane = "time"
    found_by = "frames"

    def apply(self, values: Tensor, modes_nm: Tensor, nolls: tuple[int, ...], when: Tensor) -> Tensor:
        """Coefficients of the modes with the effect, (times, modes) [nm].

        The `values` (parameters,) are those of the solver, `modes_nm` (times, modes) have the Noll indices
        `nolls`; `when` (times,) is 0 at the first frame and 1 at the last.
        """
        raise NotImplementedError


class DetectorEffect(Effect):
    """Acts on the electrons in the pixels."""

    plane = "detector"

    def apply(self, values: Tensor, images_e: Tensor) -> Tensor:
        """Images `images_e`, (..., rows, columns) [e-], as the detector shows them at `values`."""
        raise NotImplementedError

    def pushed(self, values: Tensor, images_e: Tensor, changes: Tensor) -> Tensor:
        """What small `changes` (images, changes, rows, columns) of images become; here they stay.

        `values` and `images_e` (images, rows, columns) are those of `apply`.
        """
        return changes


class RampEffect(Effect):
    """Changes the defocus that a focus stage really introduces."""

    plane = "ramp"
    found_by = "ramp"
    separated_by: str = ""  # the ramp that distinguishes it from other errors of the stage

    @classmethod
    def on_whole_ramp(cls, *, turns: bool) -> list[RampEffect]:
        """The error of a whole ramp, of which `turns` says whether the stage moves both ways."""
        return [cls()]

    @classmethod
    def on_parts(cls, offsets_nm: np.ndarray) -> list[RampEffect]:
        """Errors that concern a part of a ramp with these offsets; here none."""
        return []

    @property
    def part(self) -> dict[str, float]:
        """Options that limit it to a part of the ramp; empty where it concerns all of it."""
        return {}

    def phrase(self, public: Mapping[str, Any]) -> str:
        part = ", ".join(f"{key.removesuffix('_nm')} {nm:+.0f} nm" for key, nm in self.part.items())
        return super().phrase(public) + (f" ({part})" if part else "")

    def apply(self, values: Tensor, introduced_nm: Tensor, commanded_nm: np.ndarray) -> Tensor:
        """Introduced defocus with the effect, (frames,) [nm].

        The `values` (parameters,) are those of the solver; `introduced_nm` and `commanded_nm` (frames,) stand
        in order of recording.
        """
        raise NotImplementedError
