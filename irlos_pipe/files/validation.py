"""Check settings files; everything that is wrong is reported in lines ``file:line: message``."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from pydantic import BaseModel, ValidationError

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import nearest, suggestion
from irlos_pipe.files.yaml import line_of, load_yaml

KeyPath = tuple[str | int, ...]
Model = TypeVar("Model", bound=BaseModel)
Keys = dict[str, tuple[Any, str]]  # annotation and meaning, by name
UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
NO_SECTION = ("model_type", "dataclass_type", "named_tuple_type", "arguments_type")
MAX_SHOWN = 60  # characters of a section or list in a message


@dataclass(frozen=True)
class Origins:
    """Where each value of a settings file was given: on a line of the file, or with an option."""

    path: Path
    lines: dict[KeyPath, int]
    overrides: Sequence[tuple[KeyPath, str]] = ()

    def where(self, key: KeyPath) -> str:
        """Return ``file:line`` of the value at `key`, or the option that set it."""
        for replaced, option in reversed(self.overrides):
            within = key[: len(replaced)] == replaced
            made_by_it = key not in self.lines and replaced[: len(key)] == key
            if within or made_by_it:
                return option
        return f"{self.path}:{line_of(self.lines, key)}"


class ValidationErrors:
    """Collects what is wrong with a settings file, so that all of it can be reported at once."""

    def __init__(self, origins: Origins, rejected: Iterable[ConfigurationError] = ()) -> None:
        """Begin with options that are `rejected`, whose messages name them; values are from `origins`."""
        self.origins = origins
        self._found = [str(error).split(": ", 1) for error in rejected]

    def add(self, key: KeyPath, message: str) -> None:
        """Note a `message` about the value at `key`."""
        entry = [self.origins.where(key), message]
        if entry not in self._found:
            self._found.append(entry)

    def add_invalid(self, error: ValidationError, model: type[BaseModel], section: KeyPath = ()) -> None:
        """Note each `error` that pydantic found in a `section` that should have the form of `model`."""
        for problem in error.errors():
            self.add((*section, *problem["loc"]), _explain(dict(problem), model, section))

    def validated(self, content: Any, model: type[Model], section: KeyPath = ()) -> Model | None:
        """Return the `content` of a `section` as a `model`; None after noting what is wrong with it."""
        try:
            return model.model_validate(content)
        except ValidationError as error:
            self.add_invalid(error, model, section)
            return None

    def raise_if_any(self) -> None:
        """Raise everything that was noted as one ConfigurationError, a line each in the order of the file."""
        if self._found:
            ordered = sorted(self._found, key=lambda entry: _natural(entry[0]))
            raise ConfigurationError("\n".join(f"{where}: {message}" for where, message in ordered))


def read_validated(path: Path, model: type[Model]) -> Model:
    """Return the YAML file at `path` as a `model`; errors are those of `require_valid`."""
    data, lines = load_yaml(path)
    return require_valid(data, model, Origins(path, lines))


def require_valid(data: Any, model: type[Model], origins: Origins) -> Model:
    """Return `data`, whose values come from `origins`, as a `model`.

    Raises `ConfigurationError` with one line ``file:line: problem`` for everything that is wrong.
    """
    errors = ValidationErrors(origins)
    valid = errors.validated(data, model)
    errors.raise_if_any()
    assert valid is not None, f"{origins.path}: invalid without a reason"
    return valid


def _natural(where: str) -> tuple[str, int]:
    name, _, line = where.rpartition(":")
    return (name, int(line)) if line.isdecimal() else (where, 0)


def _explain(problem: dict, model: type[BaseModel], section: KeyPath) -> str:
    loc = problem["loc"]
    dotted = ".".join(map(str, (*section, *loc)))
    keys = _keys_at(model, loc[:-1])
    if problem["type"] in UNKNOWN:
        return f"unknown key '{dotted}'{suggestion(loc[-1], keys)}"
    if problem["type"] in ("missing", "missing_argument"):
        return f"key '{dotted}' is missing{_meaning(keys, loc)}"
    text = problem["msg"].removeprefix("Input ").removeprefix("Value error, ")
    text = (text[:1].lower() + text[1:]).replace("valid tuple", "valid list")  # as YAML calls it
    if problem["type"] in NO_SECTION:
        text = "should be a section of 'key: value' lines"
    shown = f" = {problem['input']!r}"
    if isinstance(problem["input"], (dict, list)) and len(shown) > MAX_SHOWN:
        shown = ""  # its keys stand in the file
    return f"{dotted}{shown}: {text}{_hint(problem)}{_meaning(keys, loc)}"


def _hint(problem: dict) -> str:
    if problem["type"] == "literal_error":
        close = nearest(problem["input"], re.findall(r"'([^']*)'", problem["ctx"]["expected"]))
        return f"; did you mean '{close}'?" if close else ""
    if problem["type"] in ("float_parsing", "int_parsing"):
        return "; give a plain number, its unit is in the name of the key"
    return ""


def _meaning(keys: Keys, loc: KeyPath) -> str:
    meaning = keys.get(str(loc[-1]), (None, ""))[1] if loc else ""
    return f" ({meaning})" if meaning else ""


def _keys_at(form: Any, loc: KeyPath) -> Keys:
    """Return the keys at `loc` of a section of the `form`."""
    keys = _keys(form)
    for part in loc:
        if str(part) in keys:  # list indices and tags of unions stay within the section found so far
            keys = _keys(keys[str(part)][0])
    return keys


def _keys(annotation: Any) -> Keys:
    """Return annotation and meaning of each key of the first section in an `annotation`."""
    if not isinstance(annotation, type) or get_args(annotation):
        return next(filter(None, map(_keys, get_args(annotation))), {})
    if issubclass(annotation, BaseModel):
        return {
            name: (field.annotation, field.description or "")
            for name, field in annotation.model_fields.items()
        }
    hints = get_type_hints(annotation, include_extras=True)
    if is_dataclass(annotation):
        return {
            name: (hints[field.name], field.metadata.get("description", ""))
            for field in fields(annotation)
            if (name := field.metadata.get("alias", field.name))
        }
    return {
        name: (hints[name], hints[name].__metadata__[0].meaning)
        for name in getattr(annotation, "_fields", ())
    }
