"""The `model:` section of a recipe: the PSF model that calibrate, lift, sensitivity and correct share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, field_validator

from irlos_pipe.conventions.facility import Facility
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.effects.declaration import Public
from irlos_pipe.product.results import item

FIT = "fit"


@dataclass(frozen=True)
class EffectEntry:
    """An effect as a recipe asks for it."""

    name: str
    values: dict[str, Any]  # public values it is held at, or starts from; empty if estimated from scratch
    options: dict[str, Any]
    fit: bool  # whether it is estimated all the same

    @classmethod
    def of(cls, entry: Any) -> "EffectEntry":
        """From ``name`` or ``{name: {key: value}}``; `ValueError` says what is wrong and what is allowed."""
        name, given = entry, dict[str, Any]()
        if isinstance(entry, dict) and len(entry) == 1:
            name, given = next(iter(entry.items()))
        if not isinstance(name, str) or name not in CATALOGUE:
            raise ValueError(f"unknown effect {name!r}{suggestion(name, CATALOGUE)}")
        effect = CATALOGUE[name]
        if not isinstance(given, dict):
            raise ValueError(f"{name} is fixed by {_keys(effect.public)}, not by {given!r}")
        options = {o.name: given[o.name] for o in effect.options if o.name in given}
        values = {p.name: given[p.name] for p in effect.public if p.name in given}
        unknown = sorted(set(given) - {*options, *values, FIT})
        missing = [p.name for p in effect.public if values and p.required and p.name not in values]
        if unknown or missing:
            others = f"; options: {_keys(effect.options)}" if effect.options else ""
            raise ValueError(f"{name} is fixed by {_keys(effect.public)}, not by {given!r}{others}")
        for public in (*effect.public, *effect.options):
            if public.name in given:
                _check(f"{name}.{public.name}", public, given[public.name])
        if values:
            effect.options_for(**values)  # refuses values that do not fit together
        return cls(name, values, options, not values or bool(given.get(FIT, False)))


def _keys(publics: tuple[Public, ...]) -> str:
    return "{" + ", ".join(p.name if p.required else f"[{p.name}]" for p in publics) + "}"


Real = Annotated[float, Field(strict=True)]
Whole = Annotated[int, Field(strict=True, ge=0)]
Noll = Annotated[int, Field(strict=True, ge=1)]
SOME = Field(min_length=1)
# What a value of each kind is, and how that is said.
SHAPES: Mapping[str, tuple[Any, str]] = {
    "number": (Real, "a number"),
    "word": (Annotated[str, Field(strict=True)], "a word"),
    "zernike": (Annotated[dict[Noll, Real], SOME], "a table {Noll index: value}"),
    "parts": (Annotated[Sequence[Real], SOME], "a list of numbers"),
    "pixels": (Annotated[Sequence[tuple[Whole, Whole]], SOME], "a list of [row, column]"),
    "nolls": (Annotated[Sequence[Noll], SOME], "a list of Noll indices"),
}


def _check(label: str, public: Public, value: Any) -> None:
    """Raise ValueError unless `value` is of the kind and within the limits of `public`."""
    try:
        _shape(public.kind).validate_python(value)
    except ValidationError:
        raise ValueError(f"{label} must be {SHAPES[public.kind][1]}, not {value!r}") from None
    if public.choices and value not in public.choices:
        raise ValueError(f"{label} must be {' or '.join(public.choices)}, not {value!r}")
    inner = {"number": lambda: [value], "zernike": lambda: value.values(), "parts": lambda: value}
    numbers = inner[public.kind]() if public.kind in inner else ()
    if not all(public.lower <= number <= public.upper for number in numbers):
        between = f"lie between {public.lower:g} and {public.upper:g}"
        not_negative = public.lower == 0 and public.upper == float("inf")
        raise ValueError(f"{label} must {'not be negative' if not_negative else between}, not {value!r}")


@cache
def _shape(kind: str) -> TypeAdapter[Any]:
    return TypeAdapter(SHAPES[kind][0])


class ModelConfig(BaseModel):
    """What the PSF model contains.

    An effect is named to be estimated (``seeing_halo``), given with its parameters to be held at them
    (``tip_tilt_jitter: {sigma_mas: 8}``), or to be estimated from there (the same and ``fit: true``).
    Some have options besides (``vibration: {shape: gaussian}``). Several companions, phase bumps or biases
    of parts of a ramp are listed one by one; results name the second ``companion_2``.
    """

    model_config = ConfigDict(defer_build=True, extra="forbid", frozen=True)

    effects: tuple[Annotated[Any, Field()], ...] = item(
        ("seeing_halo", "tip_tilt_jitter"),
        "effects beyond the static wavefront, by name, or {name: {parameter: value}} to fix one",
    )
    colour: Literal["auto", "listed"] = item(
        "auto",
        "auto: atmospheric dispersion and the star's colour belong to the model of calibrate and "
        "lift where the band is broad and there is an AO residual; listed: only what effects lists",
    )
    pupil_samples: int = item(128, "samples across the pupil diameter", ge=48, le=512)
    cutoff_per_m: float | None = item(
        None, "AO cut-off, 1/(2 actuator pitch) [1/m]; that of the instrument if left out", ge=0.01, le=1000
    )
    outer_scale_m: float | None = item(
        None, "outer scale of the turbulence [m]; the instrument's if left out", gt=1, le=1000
    )

    @field_validator("effects", mode="after")
    @classmethod
    def _known_effects(cls, effects: tuple) -> tuple:
        names = [EffectEntry.of(entry).name for entry in effects]
        again = sorted({name for name in names if names.count(name) > 1 and not CATALOGUE[name].repeatable})
        if again:
            raise ValueError(f"an effect is listed twice: {', '.join(again)}")
        return effects

    def completed(self, facility: Facility) -> "ModelConfig":
        """Return the section with what it leaves out taken from the `facility`."""
        absent = [name for name in ("cutoff_per_m", "outer_scale_m") if getattr(self, name) is None]
        return self.model_copy(update={name: getattr(facility, name) for name in absent})

    def entries(self) -> list[EffectEntry]:
        return [EffectEntry.of(entry) for entry in self.effects]
