"""What a physical effect declares: its numbers, and its place on the light path.

There is one base class per place. Each asks for one method, `apply`, which takes what arrives at the
place and returns it as the effect leaves it; derivatives come from forward-mode differentiation of it,
unless an effect knows a quicker way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch

from irlos_pipe.numerics.forward_mode import along, along_all
from irlos_pipe.optics.grids import OtfGrid, PupilGrid, Sampling
from irlos_pipe.optics.structure import ResidualBand

INFINITE = float("inf")
Place = Literal["pupil", "otf", "sampling", "time", "detector", "ramp"]


@dataclass(frozen=True)
class Parameter:
    """One number of an effect, as a solver sees it.

    Attributes
    ----------
    name, unit : str
    start : float
        Where a fit begins.
    prior_mean, prior_sigma : float
        Gaussian prior; an infinite sigma means none.
    lower, upper : float
        Bounds that a fit respects.
    null : float or None
        Value at which the effect is absent; None for a number that then means nothing, such as a position.
    plausible : (float, float)
        A value outside says that the effect stands in for something else.
    """

    name: str
    unit: str
    start: float
    prior_mean: float = 0.0
    prior_sigma: float = INFINITE
    lower: float = -INFINITE
    upper: float = INFINITE
    null: float | None = 0.0
    plausible: tuple[float, float] = (-INFINITE, INFINITE)


@dataclass(frozen=True)
class Public:
    """One number, list or table of an effect, as recipes and results have it.

    Attributes
    ----------
    name, unit : str
    kind : str
        A number; a table of Noll indices; four numbers, one per petal; a list of (row, column); a name.
    lower, upper : float
        Limits of every number in it.
    required : bool
        Whether an effect held at known values must be given it.
    """

    name: str
    unit: str
    kind: Literal["number", "zernike", "petals", "pixels", "nolls", "word"] = "number"
    lower: float = -INFINITE
    upper: float = INFINITE
    required: bool = True


@dataclass(frozen=True)
class Conditions:
    """Circumstances of a recording that effects may start from.

    Attributes
    ----------
    band : ResidualBand
        Spatial frequencies that the AO corrects.
    seeing_arcsec : float
    diversity : dict of int to float
        Noll index to nm RMS, as introduced.
    highest_noll : int
        Last mode that is estimated as such.
    window : (int, int)
        Rows and columns [px].
    pixel_scale_mas : float
    spectrum : tuple of (wavelength_nm, weight)
    seeing_measured : bool
        Otherwise the seeing is a typical one.
    """

    band: ResidualBand
    seeing_arcsec: float
    diversity: dict[int, float] = field(default_factory=dict)
    highest_noll: int = 30
    window: tuple[int, int] = (64, 64)
    pixel_scale_mas: float = 9.7
    spectrum: tuple[tuple[float, float], ...] = ((1600.0, 1.0),)
    seeing_measured: bool = True


class Effect:
    """What all effects have; the place says which further class to derive from.

    Class attributes
    ----------------
    name : str
        As recipes and results have it.
    place : str
    public : tuple of Public
        Numbers under their public names and units.
    options : tuple of Public
        Choices that are not estimated, arguments of the constructor.
    usual : bool
        Whether every on-sky recording has it, so that a model without a measurement takes it as expected.
    instrumental : bool
        Whether a calibration can hand it on to a recording of another star at another time.
    aberration : bool
        Whether it is a part of the static wavefront, which a calibration of NCPAs hands on.
    look_alike : str
        The effect it is most easily mistaken for, and what tells them apart.
    reference : str
    """

    name: ClassVar[str]
    place: ClassVar[Place]
    order: ClassVar[int] = 0  # among effects of the same place
    public: ClassVar[tuple[Public, ...]] = ()
    options: ClassVar[tuple[Public, ...]] = ()
    usual: ClassVar[bool] = False
    instrumental: ClassVar[bool] = True
    aberration: ClassVar[bool] = False
    look_alike: ClassVar[str] = ""
    reference: ClassVar[str] = ""
    parameters: tuple[Parameter, ...]

    @classmethod
    def under(cls, conditions: Conditions, **options: Any) -> Self:
        """The effect with starts and priors for these conditions.

        Raises
        ------
        ValueError
            If it means nothing under them.
        """
        return cls(**options)

    @classmethod
    def options_for(cls, **public: Any) -> dict[str, Any]:
        """Options under which the effect has the parameters that given public values need."""
        return {}

    def values_of(self, **public: Any) -> list[float]:
        """Solver's parameters for given values of the public ones; here they are the same."""
        return [float(public.get(p.name, p.null)) for p in self.parameters]

    def describe(self, values: Sequence[float]) -> dict[str, Any]:
        """Parameters under the public names and units of the effect catalogue."""
        return {p.name: float(v) for p, v in zip(self.parameters, values, strict=True)}

    def candidates(self, window: tuple[int, int], pixel_scale_mas: float) -> list[Any]:
        """Effects whose derivative at the null values is to be looked at when searching for this one.

        Where position, direction or size mean nothing in the absence of the effect, one per value tried:
        `Pinned` at its null values with the size left free.

        Parameters
        ----------
        window : (int, int)
            Rows and columns [px].
        pixel_scale_mas : float
        """
        return [self]

    @property
    def bare(self) -> Effect:
        """The effect itself; of a `Pinned` one, what is pinned."""
        return self

    def all_values(self, values: Sequence[float]) -> torch.Tensor:
        """Values of all parameters from those of the free ones, float64; here all are free."""
        return torch.as_tensor(values, dtype=torch.float64)

    @property
    def null_values(self) -> list[float]:
        """Values at which the effect is absent, other parameters at their start."""
        return [p.start if p.null is None else p.null for p in self.parameters]


class PupilEffect(Effect):
    """Acts on the complex amplitude in the pupil."""

    place = "pupil"
    order = 1  # after those that change where light passes, which add to the field

    def apply(self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        """`field`, (wavelengths, n, n), with the effect, which must be linear in it but for what it adds."""
        raise NotImplementedError

    def slopes(
        self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid, wanted: Sequence[int]
    ) -> list[torch.Tensor]:
        """Derivatives of `apply` with respect to the `wanted` parameters, (wavelengths, n, n) each."""
        return [along(lambda v: self.apply(v, field, grid), values, index) for index in wanted]

    def opd_nm(self, values: torch.Tensor, grid: PupilGrid) -> torch.Tensor | None:
        """The effect's part of the wavefront, (n, n) [nm]; None if it is none."""
        return None


class OtfEffect(Effect):
    """Multiplies the OTF by a factor, real or complex."""

    place = "otf"

    def apply(self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid) -> torch.Tensor:
        """`factor`, broadcastable to (wavelengths, p, p//2 + 1), times that of the effect."""
        raise NotImplementedError

    def slopes(
        self, values: torch.Tensor, factor: torch.Tensor, grid: OtfGrid, wanted: Sequence[int]
    ) -> Sequence[torch.Tensor]:
        """Derivatives of `apply` with respect to the `wanted` parameters, of the shape of `factor` each."""
        chosen = torch.as_tensor(list(wanted))

        def changed(some: torch.Tensor) -> torch.Tensor:
            return self.apply(values.index_copy(0, chosen, some), factor, grid)

        return along_all(changed, values[chosen])


class SamplingEffect(Effect):
    """Changes wavelengths, their weights, or the pixel scale."""

    place = "sampling"

    def apply(self, values: torch.Tensor, sampling: Sampling, nominal: Sampling) -> Sampling:
        """`sampling` with the effect; `nominal` is what the recording is said to have."""
        raise NotImplementedError


class TimeEffect(Effect):
    """Changes the wavefront during the recording."""

    place = "time"

    def apply(
        self, values: torch.Tensor, modes_nm: torch.Tensor, nolls: tuple[int, ...], when: torch.Tensor
    ) -> torch.Tensor:
        """Coefficients of `nolls`, (times, modes) [nm], at the times `when`: first frame 0, last frame 1."""
        raise NotImplementedError


class DetectorEffect(Effect):
    """Acts on the electrons in the pixels."""

    place = "detector"

    def apply(self, values: torch.Tensor, images_e: torch.Tensor) -> torch.Tensor:
        """Images (..., rows, columns) [e-] as the detector shows them."""
        raise NotImplementedError


class RampEffect(Effect):
    """Changes the defocus that a focus stage really introduces."""

    place = "ramp"

    def apply(
        self, values: torch.Tensor, introduced_nm: torch.Tensor, commanded_nm: np.ndarray
    ) -> torch.Tensor:
        """Introduced defocus with the effect, (frames,); `commanded_nm`: in order of recording."""
        raise NotImplementedError


def number(name: str, unit: str, lower: float = -INFINITE, upper: float = INFINITE, **more) -> Public:
    """A public number."""
    return Public(name, unit, "number", lower, upper, **more)
