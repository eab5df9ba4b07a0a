"""One entry of `model.effects` in a recipe, checked against what the effect declares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from irlos_pipe.conventions.text import suggestion
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.effects.declaration import Public

FIT = "fit"


@dataclass(frozen=True)
class EffectEntry:
    """An effect as a recipe asks for it.

    Attributes
    ----------
    name : str
    values : dict
        Public values it is held at, or starts from; empty for an effect to be estimated from scratch.
    options : dict
    fit : bool
        Whether it is estimated all the same.
    """

    name: str
    values: dict[str, Any]
    options: dict[str, Any]
    fit: bool

    @classmethod
    def of(cls, entry: Any) -> EffectEntry:
        """From ``name`` or ``{name: {key: value}}``.

        Raises
        ------
        ValueError
            Saying what is wrong and what is allowed.
        """
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


def _check(label: str, public: Public, value: Any) -> None:
    """Raise ValueError unless `value` is of the kind and within the limits of `public`."""
    shapes = {
        "number": (lambda v: _is_number(v), "a number"),
        "word": (lambda v: isinstance(v, str), "a word"),
        "zernike": (_is_table, "a table {Noll index: value}"),
        "parts": (lambda v: _is_list(v, _is_number), "a list of numbers"),
        "pixels": (lambda v: _is_list(v, _is_pixel), "a list of [row, column]"),
        "nolls": (lambda v: _is_list(v, _is_noll), "a list of Noll indices"),
    }
    fits, text = shapes[public.kind]
    if not fits(value):
        raise ValueError(f"{label} must be {text}, not {value!r}")
    if public.choices and value not in public.choices:
        raise ValueError(f"{label} must be {' or '.join(public.choices)}, not {value!r}")
    if not all(public.lower <= number <= public.upper for number in _numbers(public, value)):
        raise ValueError(f"{label} must {_limits(public)}, not {value!r}")


def _limits(public: Public) -> str:
    if public.lower == 0 and public.upper == float("inf"):
        return "not be negative"
    return f"lie between {public.lower:g} and {public.upper:g}"


def _numbers(public: Public, value: Any) -> list[float]:
    if public.kind == "number":
        return [value]
    if public.kind == "zernike":
        return list(value.values())
    return list(value) if public.kind == "parts" else []


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_noll(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


def _is_list(value: Any, fits: Callable[[Any], bool]) -> bool:
    return isinstance(value, (list, tuple)) and len(value) > 0 and all(fits(one) for one in value)


def _is_pixel(value: Any) -> bool:
    return _is_list(value, lambda n: isinstance(n, int) and n >= 0) and len(value) == 2


def _is_table(value: Any) -> bool:
    return (
        isinstance(value, dict)
        and len(value) > 0
        and all(_is_noll(key) and _is_number(one) for key, one in value.items())
    )
