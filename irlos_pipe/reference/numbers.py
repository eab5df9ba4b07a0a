"""Numbers of results.json, from the models of the stages' results."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_type_hints

from irlos_pipe.product.results import DITTO, ResultsPart
from irlos_pipe.reference.entry import Entry
from irlos_pipe.stages import LIGHT_PATH, STAGES

UNITS = {
    "nm": "nm",
    "mas": "mas",
    "e": "e-",
    "px": "px",
    "deg": "deg",
    "arcsec": "arcsec",
    "m": "m",
    "s": "s",
    "seconds": "s",
    "mag": "mag",
    "adu": "ADU",
}
ELSEWHERE = re.compile(r"[,;]? see `[\w.]+`")  # where developers read on


def number_entries() -> Iterator[Entry]:
    """Yield every key under ``stages`` of results.json."""
    for stage in LIGHT_PATH:
        yield from _entries(STAGES[stage].Results, (stage,))


def _entries(model: type, above: tuple[str, ...]) -> Iterator[Entry]:
    told = told_of(model)
    for key, annotation in fields_of(model).items():
        unit = UNITS.get(key.rpartition("_")[2], "")
        lines = [told.get(key) or _of_the_part(annotation)]
        lines += [f"unit: {unit}"] if unit else []
        name = (*above, key)
        yield Entry("number", ".".join(name), "\n".join([*lines, "in results.json under stages"]))
        for inner in models_in(annotation):
            if len(above) < 4:
                yield from _entries(inner, name)


def _of_the_part(annotation: Any) -> str:
    """What a field holds, by the first line of the model in it; empty without one."""
    model = next(models_in(annotation), None)
    text = "" if model is None else inspect.cleandoc(model.__doc__ or "").partition("\n")[0]
    return ELSEWHERE.sub("", text)


def fields_of(model: type[Any]) -> dict[str, Any]:
    """Return the annotations of what a `model` writes, by key: pydantic's, or a dataclass of science."""
    if issubclass(model, ResultsPart):
        return {key: field.annotation for key, field in model.model_fields.items()}
    hints = get_type_hints(model)
    return {field.name: hints[field.name] for field in fields(model)}


def told_of(model: type[Any]) -> dict[str, str]:
    """Return what the fields of a `model` mean, by name, as far as they say so."""
    if issubclass(model, ResultsPart):
        said = {name: field.description for name, field in model.model_fields.items()}
    else:
        said = {field.name: field.metadata.get("description") for field in fields(model)}
    found, above = {}, ""
    for name, meaning in said.items():
        above = above if meaning == DITTO else meaning or ""
        found |= {name: above} if above else {}
    return found


def models_in(annotation: Any) -> Iterator[type]:
    """Yield the models that a field with this `annotation` may hold."""
    if isinstance(annotation, type) and (is_dataclass(annotation) or issubclass(annotation, ResultsPart)):
        yield annotation
    for part in get_args(annotation):
        yield from models_in(part)
