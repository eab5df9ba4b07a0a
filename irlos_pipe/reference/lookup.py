"""Everything that can be explained, from the places that define it, and how it is looked up."""

import inspect
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import aligned, suggestion
from irlos_pipe.effects.catalogue import CATALOGUE, effect_text
from irlos_pipe.files.shipped import RECIPES, SIMULATIONS, shipped_folder, shipped_names
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.instrument.profile import FACTS, Profile
from irlos_pipe.product.product import Arrays, Checks
from irlos_pipe.product.results import ELSEWHERE, fields_of, models_in, told_of
from irlos_pipe.readers.sidecar import SidecarKeys
from irlos_pipe.recipe.load import RecipeHead
from irlos_pipe.stages import LIGHT_PATH, STAGES
from irlos_pipe.stages.base import ModelConfig

Kind = Literal[
    "stage", "key of a recipe", "key of a side-car", "key of a profile", "fact of a profile", "effect",
    "check", "number", "array of a product", "term",
]  # fmt: skip

LIMITS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
WORDS = {
    "number": "number", "integer": "whole number", "string": "text", "boolean": "true or false",
    "null": "nothing",
}  # fmt: skip
LINE_LENGTH = 100
GLOSSARY = Path(__file__).with_name("glossary.md")
TERM = re.compile(r"^\*\*(.+?)\.\*\* (.+?)(?=\n\n|\Z)", re.DOTALL | re.MULTILINE)


MOST_IN_FULL = 4  # entries of one name that are shown in full
SHORTEST_WORD = 3  # letters of a word that is searched in explanations


@dataclass(frozen=True)
class Entry:
    kind: Kind
    name: str  # where it stands, dotted: ``calibrate.method``
    text: str  # what it means, in lines; the first is a summary

    @property
    def summary(self) -> str:
        return self.text.partition("\n")[0]

    def is_called(self, name: str) -> bool:
        """Return whether `name` is the whole name, or a last part of it."""
        if self.kind == "term":
            return self.name.lower() == name.lower()
        return f".{self.name}".replace("/", ".").endswith(f".{name}".replace("/", "."))


def all_entries() -> list[Entry]:
    found = [Entry("stage", name, inspect.getdoc(STAGES[name]) or "") for name in LIGHT_PATH]
    found += [Entry("effect", name, effect_text(kind)) for name, kind in CATALOGUE.items()]
    for stage in LIGHT_PATH:  # a value out of the limits of a check makes the exit code 4
        checks: Checks = getattr(STAGES[stage], "CHECKS", {})
        for name, (text, key) in checks.items():
            limit = f"{stage}.{key}" if key else "fixed"
            found.append(Entry("check", f"{stage}.{name}", f"{text}\nlimit: {limit}"))
    found += key_entries()
    for name, rule in FACTS.items():
        limits = f"value: {rule.kind}, ≥ {rule.low:g}, ≤ {rule.high:g}"
        lines = [rule.text, f"unit: {rule.unit}", limits, *(["required"] if rule.required else [])]
        found.append(Entry("fact of a profile", f"profile.facts.{name}", "\n".join(lines)))
    found += [one for stage in LIGHT_PATH for one in _numbers(STAGES[stage].Results, (stage,))]
    for stage in LIGHT_PATH:
        arrays: Arrays = getattr(STAGES[stage], "ARRAYS", {})
        for name, (unit, axes, text) in arrays.items():
            lines = [text, *([f"unit: {unit}"] if unit else []), *([f"shape: ({axes})"] if axes else [])]
            found.append(Entry("array of a product", f"{stage}.{name}", "\n".join(lines)))
    for names, text in TERM.findall(GLOSSARY.read_text(encoding="utf-8")):
        whole = textwrap.fill(" ".join(text.split()), LINE_LENGTH)
        # one called ``A, B`` under both names
        found += [Entry("term", name, whole) for name in ([names] if "(" in names else names.split(", "))]
    return found


def explain(name: str) -> str:
    """Return what a stage, key, effect, check, number, array or term called `name` means.

    Raises `ConfigurationError` when nothing is called so.
    """
    entries = all_entries()
    wanted = name.strip().removeprefix("stages.")
    found = [entry for entry in entries if entry.is_called(wanted)]
    if not found:
        return _near(wanted, entries)
    merged = _merged(found)
    full = [entry for entry in merged if entry.kind == "term" or len(merged) <= MOST_IN_FULL]
    others = [entry for entry in merged if entry not in full]
    return "\n\n".join([*(_shown(entry, entries) for entry in full), *_tables(others)])


def _near(wanted: str, entries: Sequence[Entry]) -> str:
    """The names that hold a word that is no name, else those whose explanation holds it."""
    word = re.compile(rf"\b{re.escape(wanted.lower().replace('_', ' '))}")
    spelt = {entry: re.sub(r"[._/]", " ", entry.name.lower()) for entry in entries}
    near = [entry for entry in entries if word.search(spelt[entry])]
    near = near or [entry for entry in entries if word.search(entry.summary.lower())]
    if len(wanted) >= SHORTEST_WORD and near:
        return "\n\n".join([f"Nothing is called '{wanted}'. Near it are:", *_tables(_merged(near))])
    known = {part for entry in entries for part in (entry.name, entry.name.rpartition(".")[2])}
    known |= set(
        re.findall(r"\w{5,}", " ".join([*spelt.values(), *(one.summary.lower() for one in entries)]))
    )
    raise ConfigurationError(f"{wanted}: nothing is called so{suggestion(wanted, sorted(known))}")


def _merged(found: Iterable[Entry]) -> list[Entry]:
    """Entries of one kind with one text as one, with all their names."""
    same: dict[tuple[Kind, str], list[str]] = {}
    for entry in found:
        same.setdefault((entry.kind, entry.text), []).append(entry.name)
    return [Entry(kind, ", ".join(names), text) for (kind, text), names in same.items()]


def _tables(entries: Iterable[Entry]) -> list[str]:
    return [_table(list(group)) for _, group in groupby(entries, key=lambda one: one.kind)]


def overview() -> str:
    """Return the names of all stages, effects and checks, with their summaries."""
    entries = [one for one in all_entries() if one.kind in ("stage", "effect", "check")]
    return "\n\n".join(_tables(entries))


def _shown(entry: Entry, entries: Sequence[Entry]) -> str:
    """An entry in full; below a stage, what belongs to it in a line each."""
    first, *rest = entry.text.splitlines()
    text = "\n".join([f"{entry.name} ({entry.kind})", f"  {first}", *(f"  {line}".rstrip() for line in rest)])
    inner = [one for one in entries if one.name.startswith(f"{entry.name}.")]
    kinds = ("key of a recipe", "key of a side-car", "check", "number", "array of a product")
    groups = [[one for one in inner if one.kind == kind] for kind in kinds]
    return "\n\n".join([text, *(_table(group) for group in groups if group)])


def _table(entries: Sequence[Entry]) -> str:
    rows = aligned([(f"  {entry.name}", entry.summary) for entry in entries])
    return f"{entries[0].kind}:\n{rows}"


# -- keys of recipes, side-cars and profiles ---------------------------------------------------------

Schema = Mapping[str, Any]


def key_entries() -> Iterator[Entry]:
    """Yield the keys of a recipe, section by section, and those of a side-car."""
    yield from _keys(RecipeHead, (), "key of a recipe")
    yield from _keys(ModelConfig, ("model",), "key of a recipe")
    for stage in LIGHT_PATH:
        yield from _keys(STAGES[stage].Config, (stage,), "key of a recipe")
    yield from _keys(SidecarKeys, ("acquisition",), "key of a side-car")
    yield from _keys(Profile, ("profile",), "key of a profile")


def _keys(model: type[BaseModel], above: tuple[str, ...], kind: Kind) -> Iterator[Entry]:
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
    if "$ref" in field:
        yield known[field["$ref"].rpartition("/")[2]]
    for one in (field["items"],) if "items" in field else field.get("anyOf", ()):
        yield from _sections(one, known)


def _value(field: Schema, known: Schema) -> str:
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


# -- numbers of results.json -------------------------------------------------------------------------

UNITS = {
    "nm": "nm", "mas": "mas", "e": "e-", "px": "px", "deg": "deg", "arcsec": "arcsec", "m": "m", "s": "s",
    "seconds": "s", "mag": "mag", "adu": "ADU",
}  # fmt: skip


def _numbers(model: type, above: tuple[str, ...]) -> Iterator[Entry]:
    told = told_of(model)
    for key, annotation in fields_of(model).items():
        unit = UNITS.get(key.rpartition("_")[2], "")
        lines = [ELSEWHERE.sub("", told.get(key) or _of_the_part(annotation))]
        lines += [f"unit: {unit}"] if unit else []
        name = (*above, key)
        yield Entry("number", ".".join(name), "\n".join([*lines, "in results.json under stages"]))
        for inner in models_in(annotation):
            if len(above) < 4:
                yield from _numbers(inner, name)


def _of_the_part(annotation: Any) -> str:
    """What a field holds, by the first line of the model in it; empty without one."""
    model = next(models_in(annotation), None)
    return "" if model is None else inspect.cleandoc(model.__doc__ or "").partition("\n")[0]


def recipe_list() -> str:
    """Return a line for every recipe, with its inputs and its title, and one for every specification."""
    recipes, specs = (
        [(name, load_yaml(shipped_folder(kind) / f"{name}.yaml")[0]) for name in shipped_names(kind)]
        for kind in (RECIPES, SIMULATIONS)
    )
    rows = [(name, ", ".join(content["inputs"]), content["title"]) for name, content in recipes]
    simulated = [(name, content["title"]) for name, content in specs]
    return "\n\n".join(
        (
            f"irlos run NAME --input INPUT=PATH --output DIR\n{aligned([('NAME', 'INPUT', ''), *rows])}",
            f"irlos simulate NAME --output DIR\n{aligned([('NAME', ''), *simulated])}",
        )
    )


def recipe_text(name: str) -> str:
    """Return the file of the recipe, or of the specification, called `name`.

    Raises `ConfigurationError` when there is none.
    """
    known = [*shipped_names(RECIPES), *shipped_names(SIMULATIONS)]
    for kind in (RECIPES, SIMULATIONS):
        path = shipped_folder(kind) / f"{name}.yaml"
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise ConfigurationError(f"{name}: no recipe or specification of this name{suggestion(name, known)}")
