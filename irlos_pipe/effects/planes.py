"""One base class of effects per plane of the light path.

Each asks for one method, `apply`, which takes the solver's `values` (parameters,) and what arrives at the
plane, and returns it as the effect leaves it; derivatives come from automatic differentiation of it, unless
an effect knows a quicker way.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from irlos_pipe.conventions.late import Tensor
from irlos_pipe.effects.base import Effect


class PupilEffect(Effect):
    """Acts on the complex amplitude in the pupil.

    ``apply(values, field, grid)`` returns the `field` (wavelengths, n, n) with the effect, which must be
    linear in it but for what it adds; `grid` is that of the pupil.
    """

    plane = "pupil"
    order = 1  # after those that change where light passes, which add to the field


class OtfEffect(Effect):
    """Multiplies the OTF by a factor, real or complex.

    ``apply(values, factor, grid)`` returns the `factor`, broadcastable to (wavelengths, p, p//2 + 1), times
    that of the effect on an `OtfGrid`.
    """

    plane = "otf"


class CopyOfStar(OtfEffect):
    """A further image of the star that has a focus of its own: the OTF factor of its light path.

    There it stands in the place of the effect that has it among its `Effect.further_paths`, and has its
    parameters.
    """

    def defocus_nm(self, values: Tensor) -> Tensor:
        """Noll 4 beyond that of the star, a scalar [nm RMS]."""
        raise NotImplementedError


class SamplingEffect(Effect):
    """Changes wavelengths, their weights, or the pixel scale.

    ``apply(values, sampling, nominal)`` returns the `sampling` with the effect; `nominal` is what the
    recording is said to have.
    """

    plane = "sampling"


class LensEffect(Effect):
    """Changes what introduced defocus is; held in the settings of the light path.

    ``apply(values, settings)`` returns the `PsfSettings` of a light path with the effect.
    """

    plane = "lens"
    found_by = "ramp"

    def __init__(self, numerical_aperture: float = 0.0):
        """Start from the `numerical_aperture`, NA / n, of the beam in which the focus moves."""


class TimeEffect(Effect):
    """Changes the wavefront during the recording.

    ``apply(values, modes_nm, nolls, when)`` returns the coefficients `modes_nm` (times, modes) [nm], of Noll
    indices `nolls`, with the effect; `when` (times,) is 0 at the first frame and 1 at the last.
    """

    plane = "time"
    found_by = "frames"


class DetectorEffect(Effect):
    """Acts on the electrons in the pixels.

    ``apply(values, images_e)`` returns images, (..., rows, columns) [e-], as the detector shows them.
    """

    plane = "detector"

    def pushed(self, values: Tensor, images_e: Tensor, changes: Tensor) -> Tensor:
        """What small `changes` (images, changes, rows, columns) of images become; here they stay.

        `values` and `images_e` (images, rows, columns) are those of `apply`.
        """
        return changes


class RampEffect(Effect):
    """Changes the defocus that a focus stage really introduces.

    ``apply(values, introduced_nm, commanded_nm)`` returns the introduced defocus with the effect, (frames,)
    [nm], all of them in order of recording.
    """

    plane = "ramp"
    found_by = "ramp"
    separated_by: str = ""  # the ramp that distinguishes it from other errors of the stage

    @classmethod
    def on_whole_ramp(cls, *, turns: bool) -> "list[RampEffect]":
        """The error of a whole ramp, of which `turns` says whether the stage moves both ways."""
        return [cls()]

    @classmethod
    def on_parts(cls, offsets_nm: np.ndarray) -> "list[RampEffect]":
        """Errors that concern a part of a ramp with these offsets; here none."""
        return []

    @property
    def part(self) -> dict[str, float]:
        """Options that limit it to a part of the ramp; empty where it concerns all of it."""
        return {}

    def phrase(self, public: Mapping[str, Any]) -> str:
        part = ", ".join(f"{key.removesuffix('_nm')} {nm:+.0f} nm" for key, nm in self.part.items())
        return super().phrase(public) + (f" ({part})" if part else "")
