"""The section `effects` of a spec: what acts on the data and the side-car does not state.

Its keys are generated. Which parameters an effect has, and which of them may be left out, stands in the
simulator's class; names, units and limits of those that models have stand in `irlos_pipe.effects`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from math import isfinite
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from pydantic import AfterValidator, AliasChoices, BaseModel, ConfigDict, Field, create_model, model_validator

from irlos_pipe.effects import CATALOGUE
from irlos_pipe.effects.declaration import Public
from irlos_pipe.simulate.detector import Pixel
from irlos_pipe.simulate.effects.base import Own, SimulatedEffect
from irlos_pipe.simulate.effects.catalogue import EFFECTS, effects_of
from irlos_pipe.simulate.errors import SceneError


class Section(BaseModel):
    """Base of all sections of a spec: unknown keys and values that are not finite are refused."""

    model_config = ConfigDict(defer_build=True, extra="forbid", frozen=True, allow_inf_nan=False)


def require_nolls(values: dict[int, float]) -> dict[int, float]:
    """Return `values` by Noll index, all from 2 to 1000."""
    for noll in values:
        if not 2 <= noll <= 1000:
            raise ValueError(f"{noll} is no Noll index from 2 to 1000")
    return values


class EffectSection(Section):
    """Parameters of one effect."""

    @model_validator(mode="before")
    @classmethod
    def _single_value(cls, value: Any) -> Any:
        """Accept the list alone where an effect needs nothing else."""
        required = [name for name, field in cls.model_fields.items() if field.is_required()]
        return {required[0]: value} if isinstance(value, list) and len(required) == 1 else value

    @model_validator(mode="after")
    def _consistent(self) -> EffectSection:
        name = type(self).__name__
        try:
            effects_of({name: self.model_dump(exclude_none=True)})
        except SceneError as problem:
            raise ValueError(str(problem).removeprefix(f"effects.{name}: ")) from None
        return self


class EffectsSection(Section):
    """The effects of a recording, by name."""

    def given(self) -> dict[str, Mapping[str, Any]]:
        """Return the parameters of the effects that are switched on, by name."""
        sections = {name: getattr(self, name) for name in type(self).model_fields}
        return {
            name: section.model_dump(exclude_none=True)
            for name, section in sections.items()
            if section is not None
        }


def _section(effect: type[SimulatedEffect]) -> type[EffectSection]:
    """Return the form of the parameters of an `effect`; it is named like the effect."""
    public = {one.name: one for one in (*CATALOGUE[effect.name].public, *CATALOGUE[effect.name].options)}
    hints = get_type_hints(effect)
    keys: dict[str, Any] = {}
    for field in dataclasses.fields(effect):
        declared: Public | Own = field.metadata.get("own") or public.get(field.name) or Own("")
        if limits := field.metadata.get("wider"):
            declared = dataclasses.replace(declared, lower=limits[0], upper=limits[1])
        names = [field.name, *filter(None, [field.metadata.get("formerly")])]
        keys[field.name] = (
            _type(hints[field.name], declared),
            Field(
                ... if field.default is dataclasses.MISSING else field.default,
                description=declared.unit,
                validation_alias=AliasChoices(*names) if len(names) > 1 else None,
            ),
        )
    return create_model(effect.name, __base__=EffectSection, __doc__=effect.__doc__, **keys)


def _type(hint: Any, declared: Public | Own) -> Any:
    """Return the type of a key for the `hint` of the simulator's field and the `declared` limits."""
    optional = NoneType in get_args(hint)
    hint = next(one for one in get_args(hint) if one is not NoneType) if optional else hint
    number = _number(declared.lower, declared.upper)
    kind = declared.kind if isinstance(declared, Public) else "number"
    if get_origin(hint) is Literal:
        key = hint
    elif kind == "parts":
        key = Annotated[list[number], Field(min_length=1)]  # type: ignore[valid-type]
    elif kind == "zernike":
        key = Annotated[dict[int, number], AfterValidator(require_nolls)]  # type: ignore[valid-type]
    elif kind == "pixels":
        key = Annotated[list[Pixel], Field(min_length=1)]
    else:
        key = list[number] if get_origin(hint) is Sequence else number  # type: ignore[valid-type]
    return key | None if optional else key


def _number(lower: float, upper: float) -> Any:
    return Annotated[
        float, Field(ge=lower if isfinite(lower) else None, le=upper if isfinite(upper) else None)
    ]


_SECTIONS: dict[str, Any] = {name: (_section(effect) | None, None) for name, effect in EFFECTS.items()}
EffectKeys = create_model("EffectKeys", __base__=EffectsSection, **_SECTIONS)
