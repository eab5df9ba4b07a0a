"""What a physical effect is: parameters, and what it does to what arrives at its plane of the light path.

There is one base class per plane. Each asks for one method, `apply`, which takes what arrives at the
plane and returns it as the effect leaves it; derivatives come from forward-mode differentiation of it,
unless an effect knows a quicker way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
import torch

from irlos_pipe.effects.declaration import Conditions, Parameter, Plane, Public
from irlos_pipe.numerics.forward_mode import along, along_all
from irlos_pipe.optics.grids import OtfGrid, PupilGrid, Sampling


class Effect:
    """What all effects have; the plane says which further class to derive from.

    Class attributes
    ----------------
    name : str
        As recipes and results have it.
    plane : str
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

    name: str
    plane: Plane
    order: int = 0  # among effects of the same plane
    public: tuple[Public, ...] = ()
    options: tuple[Public, ...] = ()
    usual: bool = False
    instrumental: bool = True
    aberration: bool = False
    look_alike: str = ""
    reference: str = ""
    parameters: tuple[Parameter, ...] = ()

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

    def candidates(self, window: tuple[int, int], pixel_scale_mas: float) -> Sequence[Effect]:
        """Effects whose derivative at the null values is to be looked at when searching for this one.

        Where position, direction or size mean nothing in the absence of the effect, one per value tried:
        `FixedEffect` at its null values with the size left free.

        Parameters
        ----------
        window : (int, int)
            Rows and columns [px].
        pixel_scale_mas : float
        """
        return [self]

    def apply(self, values: torch.Tensor, *light: Any, **more: Any) -> Any:
        """What arrives at the plane, as the effect leaves it; see the base class of the plane."""
        raise NotImplementedError

    def slopes(
        self, values: torch.Tensor, light: torch.Tensor, grid: Any, wanted: Sequence[int]
    ) -> Sequence[torch.Tensor]:
        """Derivatives of `apply` with respect to the `wanted` parameters, in the pupil and of the OTF."""
        raise NotImplementedError

    def opd_nm(self, values: torch.Tensor, grid: PupilGrid) -> torch.Tensor | None:
        """The effect's part of the wavefront, (n, n) [nm]; None if it is none."""
        return None

    @property
    def base(self) -> Effect:
        """The effect itself; of a `FixedEffect`, the effect whose parameters are held."""
        return self

    @property
    def needs_search(self) -> bool:
        """Whether a fit needs a search first: some parameters mean nothing in the effect's absence."""
        return not self.usual and any(p.null is None for p in self.parameters)

    def expected(self) -> Effect:
        """The effect held at what is to be expected: a usual one at its start, others absent."""
        if not self.parameters:
            return self
        return FixedEffect(self, [p.start for p in self.parameters] if self.usual else self.null_values)

    def all_values(self, values: Sequence[float]) -> torch.Tensor:
        """Values of all parameters from those of the free ones, float64; here all are free."""
        return torch.as_tensor(values, dtype=torch.float64)

    @property
    def null_values(self) -> list[float]:
        """Values at which the effect is absent, other parameters at their start."""
        return [p.start if p.null is None else p.null for p in self.parameters]


class FixedEffect(Effect):
    """An effect with every parameter held at a value, except those named in `free`, which start there.

    This is how parameters estimated by one stage are handed on to the next.

    Parameters
    ----------
    base : Effect
        What it declares holds for this one as well.
    values : sequence of float, (parameters of the base effect,)
    free : sequence of str
    """

    def __init__(self, base: Effect, values: Sequence[float], free: Sequence[str] = ()):
        for declared in Effect.__annotations__:
            setattr(self, declared, getattr(base, declared))
        self._base = base
        self.values = np.array(values, float)
        self.free = [i for i, p in enumerate(base.parameters) if p.name in free]
        self.parameters = tuple(replace(base.parameters[i], start=float(self.values[i])) for i in self.free)

    @property
    def base(self) -> Effect:
        """See `Effect.base`."""
        return self._base

    def all_values(self, values: Sequence[float]) -> torch.Tensor:
        """See `Effect.all_values`."""
        full = torch.as_tensor(self.values, dtype=torch.float64)
        if not self.free:
            return full
        chosen = torch.as_tensor(np.eye(len(self.values))[self.free])
        held = torch.as_tensor(np.isin(np.arange(len(self.values)), self.free, invert=True))
        return full * held + torch.as_tensor(values, dtype=torch.float64) @ chosen

    @property
    def needs_search(self) -> bool:
        """See `Effect.needs_search`: where it starts is known."""
        return False

    def expected(self) -> Effect:
        """See `Effect.expected`."""
        return FixedEffect(self.base, self.values) if self.free else self

    def apply(self, values: torch.Tensor, *light: Any, **more: Any) -> Any:
        """See `Effect.apply`."""
        return self.base.apply(self.all_values(values), *light, **more)

    def slopes(
        self, values: torch.Tensor, light: torch.Tensor, grid: Any, wanted: Sequence[int]
    ) -> Sequence[torch.Tensor]:
        """See `Effect.slopes`."""
        return self.base.slopes(self.all_values(values), light, grid, [self.free[i] for i in wanted])

    def opd_nm(self, values: torch.Tensor, grid: PupilGrid) -> torch.Tensor | None:
        """See `Effect.opd_nm`."""
        return self.base.opd_nm(self.all_values(values), grid)

    def describe(self, values: Sequence[float]) -> dict[str, Any]:
        """See `Effect.describe`."""
        return self.base.describe(self.all_values(values).numpy())


def expected(effects: Sequence[Effect]) -> list[Effect]:
    """The same effects held at what is to be expected: usual ones at their start, others absent."""
    return [effect.expected() for effect in effects]


class PupilEffect(Effect):
    """Acts on the complex amplitude in the pupil."""

    plane = "pupil"
    order = 1  # after those that change where light passes, which add to the field

    def apply(self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid) -> torch.Tensor:
        """`field`, (wavelengths, n, n), with the effect, which must be linear in it but for what it adds."""
        raise NotImplementedError

    def slopes(
        self, values: torch.Tensor, field: torch.Tensor, grid: PupilGrid, wanted: Sequence[int]
    ) -> list[torch.Tensor]:
        """Derivatives of `apply` with respect to the `wanted` parameters, (wavelengths, n, n) each."""
        return [along(lambda v: self.apply(v, field, grid), values, index) for index in wanted]


class OtfEffect(Effect):
    """Multiplies the OTF by a factor, real or complex."""

    plane = "otf"

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

    plane = "sampling"

    def apply(self, values: torch.Tensor, sampling: Sampling, nominal: Sampling) -> Sampling:
        """`sampling` with the effect; `nominal` is what the recording is said to have."""
        raise NotImplementedError


class TimeEffect(Effect):
    """Changes the wavefront during the recording."""

    plane = "time"

    def apply(
        self, values: torch.Tensor, modes_nm: torch.Tensor, nolls: tuple[int, ...], when: torch.Tensor
    ) -> torch.Tensor:
        """Coefficients of `nolls`, (times, modes) [nm], at the times `when`: first frame 0, last frame 1."""
        raise NotImplementedError


class DetectorEffect(Effect):
    """Acts on the electrons in the pixels."""

    plane = "detector"

    def apply(self, values: torch.Tensor, images_e: torch.Tensor) -> torch.Tensor:
        """Images (..., rows, columns) [e-] as the detector shows them."""
        raise NotImplementedError


class RampEffect(Effect):
    """Changes the defocus that a focus stage really introduces."""

    plane = "ramp"

    def apply(
        self, values: torch.Tensor, introduced_nm: torch.Tensor, commanded_nm: np.ndarray
    ) -> torch.Tensor:
        """Introduced defocus with the effect, (frames,); `commanded_nm`: in order of recording."""
        raise NotImplementedError
