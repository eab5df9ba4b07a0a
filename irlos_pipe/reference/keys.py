"""Keys of recipes and side-cars, from the models that check them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel

from irlos_pipe.instrument.facts import FACTS
from irlos_pipe.instrument.profile import Profile
from irlos_pipe.readers.sidecar import AcquisitionKeys
from irlos_pipe.recipe.load import RecipeHead
from irlos_pipe.reference.entry import Entry, Kind
from irlos_pipe.stages import LIGHT_PATH, STAGES
from irlos_pipe.stages.model.section import ModelConfig

Schema = Mapping[str, Any]
LIMITS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
WORDS = {
    "number": "number",
    "integer": "whole number",
    "string": "text",
    "boolean": "true or false",
    "null": "nothing",
}


def key_entries() -> Iterator[Entry]:
    """Yield the keys of a recipe, section by section, and those of a side-car."""
    yield from _entries(RecipeHead, (), "key of a recipe")
    yield from _entries(ModelConfig, ("model",), "key of a recipe")
    for stage in LIGHT_PATH:
        yield from _entries(STAGES[stage].Config, (stage,), "key of a recipe")
    yield from _entries(AcquisitionKeys, ("acquisition",), "key of a side-car")
    yield from _entries(Profile, ("profile",), "key of a profile")


def fact_entries() -> Iterator[Entry]:
    """Yield the facts that a profile may state."""
    for name, rule in FACTS.items():
        limits = f"value: {rule.kind}, ≥ {rule.low:g}, ≤ {rule.high:g}"
        lines = [rule.text, f"unit: {rule.unit}", limits, *(["required"] if rule.required else [])]
        yield Entry("fact of a profile", f"profile.facts.{name}", "\n".join(lines))


def _entries(model: type[BaseModel], above: tuple[str, ...], kind: Kind) -> Iterator[Entry]:
    schema = model.model_json_schema()
    yield from _of_section(schema, schema.get("$defs", {}), above, kind)


def _of_section(section: Schema, known: Schema, above: tuple[str, ...], kind: Kind) -> Iterator[Entry]:
    for key, field in section.get("properties", {}).items():
        name = (*above, key)
        required = key in section.get("required", ())
        lines = [field.get("description", key.replace("_", " "))]
        if kind == "key of a side-car":
            lines.append(f"value: {_value(field, known).removesuffix(' or nothing')}")
        else:
            default = "required" if required else f"default: {_default(field.get('default'))}"
            lines += [f"value: {_value(field, known)}", default]
        yield Entry(kind, ".".join(name), "\n".join(lines))
        # the keys of a side-car in a recipe are explained as those of a side-car
        inner = next(_sections(field, known), None)
        if inner is not None and not key.startswith("acquisition"):
            yield from _of_section(inner, known, name, kind)


def _sections(field: Schema, known: Schema) -> Iterator[Schema]:
    """Yield the sections that a field may hold."""
    if "$ref" in field:
        yield known[field["$ref"].rpartition("/")[2]]
    for one in (field["items"],) if "items" in field else field.get("anyOf", ()):
        yield from _sections(one, known)


def _value(field: Schema, known: Schema) -> str:
    """Return what a field may hold, in words."""
    if "anyOf" in field:
        return " or ".join(dict.fromkeys(_value(one, known) for one in field["anyOf"]))
    if "enum" in field or "const" in field:
        return ", ".join(map(str, field.get("enum", [field.get("const")])))
    if "$ref" in field:
        return f"section with {', '.join(known[field['$ref'].rpartition('/')[2]].get('properties', {}))}"
    if field.get("type") == "array":
        return f"list of {_value(field.get('items', {}), known)}"
    if field.get("type") == "object":
        return "table"
    limits = [f"{sign} {field[name]:g}" for name, sign in LIMITS.items() if name in field]
    return " ".join([WORDS.get(field.get("type", ""), "any"), ", ".join(limits)]).strip()


def _default(value: Any) -> str:
    if value is None:
        return "none"
    return str(value).lower() if isinstance(value, bool) else str(value)
