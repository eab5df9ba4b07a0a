"""What a physical effect is: what it declares, its parameters, and that some of them may be held."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Any, Self, TypeAlias

import numpy as np

from irlos_pipe.conventions.late import Tensor, torch
from irlos_pipe.effects.declaration import Calibrated, Conditions, Declared, Parameter, Role
from irlos_pipe.numerics.directional import Directional
from irlos_pipe.optics.grids import PupilGrid, PupilMode

# Of an effect with a distance and a direction, such as a displaced stop. To first order opposite sides make
# the same image, which has a kink at no distance: a fit stays on its side.
AT_REST = 1e-3  # largest distance, in the unit of the parameter, that counts as none
Values: TypeAlias = "Sequence[float] | np.ndarray | Tensor"


class Effect(Declared):
    """What all effects have; the plane says which further class to derive from."""

    @classmethod
    def under(cls, conditions: Conditions, *args: Any, **options: Any) -> Self:
        """The effect with starts and priors for these conditions.

        Raises `ValueError` if it means nothing under them.
        """
        return cls(*args, **options)

    @classmethod
    def variants(cls, conditions: Conditions) -> tuple[Effect, ...]:
        """Shapes of the effect that a diagnosis tries under `conditions`."""
        return (cls.under(conditions),)

    @classmethod
    def options_for(cls, **public: Any) -> dict[str, Any]:
        """Options under which the effect has the parameters that given public values need."""
        return {}

    def shown(self, values: np.ndarray) -> dict[str, Any]:
        """What reports state of it: public values, or what the data determine of them.

        Of parts of the pupil these are differences from their mean, of a table of modes their RMS as well.
        """
        return self.describe(values)

    def values_of(self, *args: Any, **public: Any) -> list[float]:
        """Solver's parameters for given values of the public ones; here they are the same."""
        return [float(public.get(p.name, p.null or 0.0)) for p in self.parameters]

    def describe(self, values: np.ndarray) -> dict[str, Any]:
        """Parameters under the public names and units of the effect catalogue."""
        return {p.name: float(v) for p, v in zip(self.parameters, values, strict=True)}

    def candidates(self, window: tuple[int, int], pixel_scale_mas: float) -> Sequence[Effect]:
        """Effects whose derivative at the null values is to be looked at when searching for this one.

        Where position, direction or size mean nothing in the absence of the effect, one per value tried:
        `FixedEffect` at its null values with the size left free. The `window` has rows and columns of pixels
        of `pixel_scale_mas`.
        """
        return [self]

    @classmethod
    def together(cls, effects: Sequence[Effect]) -> Effect | None:
        """Several `effects` of this kind, or with the same `joins`, as one.

        None where each acts on what the one before it leaves.
        """
        return None

    def apply(self, values: Tensor, *light: Any, **more: Any) -> Any:
        """What arrives at the plane, as the effect leaves it; see the base class of the plane."""
        raise NotImplementedError

    def slopes(self, values: Tensor, light: Tensor, grid: Any, wanted: Sequence[int]) -> Sequence[Tensor]:
        """Derivatives of `apply`, in the pupil and of the OTF, by the `wanted` parameters.

        `values`, `light` and `grid` are those of `apply`; each derivative has the shape of what it returns.
        """
        change = Directional(lambda v: self.apply(v, light, grid), values)
        return [change.by(index) for index in wanted]

    @property
    def further_paths(self) -> Sequence[tuple[PupilMode | None, Effect]]:
        """Light paths next to that of the star, each with the effect that stands there in this one's place.

        With a mode they are those of `Optics.by_mode`; without, a `planes.CopyOfStar`: an image of the star
        that has a focus of its own.
        """
        return ()

    def opd_nm(self, values: Tensor, grid: PupilGrid) -> Tensor | None:
        """The effect's part of the wavefront at `values` on `grid`, (n, n) [nm]; None if it is none."""
        return None

    def good_pixels(self, window: tuple[int, int]) -> np.ndarray:
        """False for pixels of the `window` that the effect masks, (rows, columns)."""
        return np.ones(window, dtype=bool)

    def seen_in(self, here: Conditions, first: Conditions) -> Effect:
        """The effect, stated for a `first` recording, as it acts in another one taken under `here`."""
        return self

    def shown_by(self, recordings: Sequence[Conditions]) -> bool:
        """Whether `recordings` taken under these conditions can distinguish it from the static wavefront."""
        return True

    def imitated_in(self, recordings: Sequence[Conditions]) -> bool:
        """Whether a mode of the wavefront is exactly like it in `recordings` taken under these conditions."""
        return False

    def handed_on(self, values: np.ndarray, now: Conditions, then: Calibrated) -> FixedEffect:
        """The effect for a recording taken under `now`, as a calibration found its `values` under `then`."""
        return FixedEffect(self, values)

    def whole(self, start: FixedEffect, sizes: np.ndarray) -> FixedEffect:
        """What a fit begins with whose search found `start` with these `sizes`; here the same."""
        return start

    def acting(self, moment: int) -> bool:
        """Whether the effect acts in a `moment`, see `acts_in`."""
        return self.acts_in is None or moment in self.acts_in

    def only_in(self, moments: frozenset[int] | None) -> Self:
        """Return the effect, acting in some `moments` of recordings that are diagnosed together."""
        other = copy(self)
        other.acts_in = moments
        return other

    def displaced(self, x_mas: float, y_mas: float) -> FixedEffect:
        """Return a candidate whose copy of the star lies at (`x_mas`, `y_mas`)."""
        raise NotImplementedError(f"{self.name} adds no copy of the star")

    def phrase(self, public: Mapping[str, Any]) -> str:
        """The effect with its size, as a sentence names it; `public`: as `describe` and `shown` have them."""
        if self.sentence:
            return self.sentence.format(**public)
        return f"{self.name} with " + ", ".join(f"{key} {value:.3g}" for key, value in public.items())

    def role_of(self, name: str) -> Role:
        """Role of a public value, see `Public`."""
        return next((one.role for one in (*self.public, *self.derived) if one.name == name), "size")

    def unusual(self, values: Values) -> list[str]:
        """Parameters whose values, (parameters,), lie at a bound or outside the plausible range."""
        pairs = zip(self.parameters, np.asarray(values, float).tolist(), strict=True)
        return [parameter.name for parameter, value in pairs if not parameter.allows(value)]

    def ordinary(self, values: Values) -> bool:
        """Whether any instrument has such `values` (parameters,): of a fact, within two σ of its prior."""
        pairs = zip(self.parameters, np.asarray(values, float).tolist(), strict=True)
        with_null = [(p, value) for p, value in pairs if p.null is not None]
        return self.fact and all(abs(value - p.null) <= 2 * p.prior_sigma for p, value in with_null)

    @property
    def base(self) -> Effect:
        """The effect itself; of a `FixedEffect`, the effect whose parameters are held."""
        return self

    @property
    def free(self) -> list[int]:
        """Positions of the free parameters among those of the base effect."""
        return list(range(len(self.parameters)))

    @property
    def needs_search(self) -> bool:
        """Whether a fit needs a search first: some parameters mean nothing in the effect's absence."""
        return not self.usual and any(p.null is None for p in self.parameters)

    def expected(self) -> Effect:
        """The effect held at what is to be expected: a usual one at its start, others absent."""
        if not self.parameters:
            return self
        return FixedEffect(self, [p.start for p in self.parameters] if self.usual else self.null_values)

    def all_values(self, values: Values) -> Tensor:
        """Values of all parameters from those of the free ones, float64; here all are free."""
        return torch.as_tensor(values, dtype=torch.float64)

    @property
    def null_values(self) -> list[float]:
        """Values at which the effect is absent, other parameters at their start."""
        return [p.start if p.null is None else p.null for p in self.parameters]


def _of_all(method: str, as_array: bool = False) -> Any:
    """A method of a `FixedEffect`: that of its base, for the values of all parameters."""

    def ours(self: FixedEffect, values: Tensor, *light: Any, **more: Any) -> Any:
        every = self.all_values(values)
        return getattr(self.base, method)(every.numpy() if as_array else every, *light, **more)

    return ours


class FixedEffect(Effect):
    """An effect with every parameter held at a value, except those named in `free`, which start there.

    This is how parameters estimated by one stage are handed on to the next. What the effect `base` declares
    holds for this one as well; `values` are those of all its parameters.
    """

    def __init__(self, base: Effect, values: Values, free: Sequence[str] = ()):
        for declared in Declared.__annotations__:
            setattr(self, declared, getattr(base, declared))
        self._base = base
        self.values = np.array(np.asarray(values), float)
        self._free = [i for i, p in enumerate(base.parameters) if p.name in free]
        self.parameters = tuple(replace(base.parameters[i], start=float(self.values[i])) for i in self._free)

    def only_in(self, moments: frozenset[int] | None) -> Self:
        other = super().only_in(moments)
        other._base = self._base.only_in(moments)
        return other

    @property
    def base(self) -> Effect:
        return self._base

    @property
    def free(self) -> list[int]:
        return self._free

    def all_values(self, values: Values) -> Tensor:
        held, chosen = self._parts
        return held + torch.as_tensor(values, dtype=torch.float64) @ chosen if self.free else held.clone()

    @cached_property
    def _parts(self) -> tuple[Tensor, Tensor]:
        """All values with 0 for the free ones, and the rows that put these in their places."""
        held = self.values.copy()
        held[self.free] = 0.0
        return torch.as_tensor(held), torch.as_tensor(np.eye(len(held))[self.free])

    @property
    def needs_search(self) -> bool:
        """See `Effect.needs_search`: where it starts is known."""
        return False

    def expected(self) -> Effect:
        return FixedEffect(self.base, self.values) if self.free else self

    apply, pushed, opd_nm = _of_all("apply"), _of_all("pushed"), _of_all("opd_nm")
    defocus_nm = _of_all("defocus_nm")
    describe, shown = _of_all("describe", as_array=True), _of_all("shown", as_array=True)

    def slopes(self, values: Tensor, light: Tensor, grid: Any, wanted: Sequence[int]) -> Sequence[Tensor]:
        return self.base.slopes(self.all_values(values), light, grid, [self.free[i] for i in wanted])

    def _of_other(self, base: Effect) -> FixedEffect:
        return FixedEffect(base, self.values, [self.base.parameters[i].name for i in self.free])

    @property
    def further_paths(self) -> Sequence[tuple[PupilMode | None, Effect]]:
        return [(mode, self._of_other(one)) for mode, one in self.base.further_paths]

    def seen_in(self, here: Conditions, first: Conditions) -> Effect:
        return self._of_other(self.base.seen_in(here, first))

    def shown_by(self, recordings: Sequence[Conditions]) -> bool:
        """See `Effect.shown_by`; what is held needs no showing."""
        return not self.free or self.base.shown_by(recordings)

    def good_pixels(self, window: tuple[int, int]) -> np.ndarray:
        return self.base.good_pixels(window)

    def phrase(self, public: Mapping[str, Any]) -> str:
        return self.base.phrase(public)


class Several(Effect):
    """Several effects as one, with the free parameters of each in order; beside the class of their plane."""

    def __init__(self, effects: Sequence[Effect]):
        self.every = tuple(effects)
        self.parameters = tuple(p for one in effects for p in one.parameters)

    def all_of_each(self, values: Tensor) -> list[Tensor]:
        """Return all parameters of every effect from the free ones, `values`."""
        pieces = values.split([len(one.parameters) for one in self.every])
        return [one.all_values(piece) for one, piece in zip(self.every, pieces, strict=True)]


def expected(effects: Sequence[Effect]) -> list[Effect]:
    """`effects` held at what is to be expected: usual ones at their start, others absent."""
    return [effect.expected() for effect in effects]


def occurrences(names: Iterable[str]) -> list[int]:
    """How many of the same name come before each of `names`."""
    kinds = list(names)
    return [kinds[:place].count(name) for place, name in enumerate(kinds)]


def labels_of(effects: Sequence[Effect]) -> list[str]:
    """Unique labels of `effects` in this order: the name, and of a second of its kind ``name_2``."""
    names = [effect.name for effect in effects]
    return [label_of(name, before) for name, before in zip(names, occurrences(names), strict=True)]


def label_of(name: str, before: int) -> str:
    """Label of an effect with this `name` of which there are some `before` it."""
    return f"{name}_{before + 1}" if before else name


def kind_of(label: str) -> str:
    """Name of an effect with this label."""
    name, _, number = label.rpartition("_")
    return name if name and number.isdecimal() else label


def direction_among(parameters: Sequence[Parameter]) -> int | None:
    """Return which of the free `parameters` of an effect is its direction; None without distance and
    direction.

    The distance is the first, where there is one.
    """
    angles = [i for i, one in enumerate(parameters) if one.null is None and one.unit == "rad"]
    if not angles or parameters[0].null is None or parameters[0].null > parameters[0].lower:
        return None
    return angles[0]
