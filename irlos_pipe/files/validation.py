"""Check settings files; everything that is wrong is reported in lines ``file:line: message``."""

import os
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import nearest, suggestion
from irlos_pipe.files.yaml import line_of, load_yaml, parse_yaml

KeyPath = tuple[str | int, ...]
Model = TypeVar("Model", bound=BaseModel)
Keys = dict[str, tuple[Any, str]]  # annotation and meaning, by name
UNKNOWN = ("extra_forbidden", "unexpected_keyword_argument")
NO_SECTION = ("model_type", "dataclass_type", "named_tuple_type", "arguments_type")
MAX_SHOWN = 60  # characters of a section or list in a message

EXAMPLE = "stage.key=VALUE, for example calibrate.method=dip_avg"


class Section(BaseModel):
    """Base of the sections of a file: unknown keys and values that are not finite are refused."""

    model_config = ConfigDict(defer_build=True, extra="forbid", frozen=True, allow_inf_nan=False)


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


Parsed = TypeVar("Parsed")
Given = TypeVar("Given")


@dataclass(frozen=True)
class Override:
    """A value that replaces the file's at a `key` path; `where`, ``--set a.b``, is what messages name."""

    key: tuple[str | int, ...]
    value: Any
    where: str


def parse_setting(text: str, example: str = EXAMPLE) -> Override:
    """Parse the `text` ``stage.key=VALUE``, the value in YAML; `example` is what the error asks for.

    Raises `ConfigurationError` when there is no ``=``, no key, or the value is not YAML.
    """
    dotted, equals, value = text.partition("=")
    parts = dotted.strip().split(".")
    if not equals or not all(parts):
        raise ConfigurationError(f"--set {text}: expected {example}")
    where = f"--set {dotted.strip()}"
    key = tuple(int(part) if part.isdecimal() else part for part in parts)
    return Override(key, _yaml_value(value, where), where)


def read_overridden(
    path: Path,
    parse: Callable[[Given], Override],
    settings: Iterable[Given] = (),
    inputs: Iterable[str] = (),
    seed: int | None = None,
) -> tuple[dict, ValidationErrors]:
    """Read the settings file at `path` and replace what the command line gives.

    Returns its content with the replaced values; and what was wrong with the options, with where every value
    comes from. `parse` makes an override of one of the `settings`: ``key.key=VALUE`` or what else it takes,
    applied in order; the value is YAML. The `inputs` are ``NAME=PATH``, relative to the current folder; a
    name given again makes a list. A `seed` replaces the value of ``seed``.
    """
    written, lines = load_yaml(path)
    rejected: list[ConfigurationError] = []
    overrides = _accepted(parse, settings, rejected)
    overrides += [] if seed is None else [Override(("seed",), seed, "--seed")]
    paths: dict[str, list[str]] = {}
    for name, place in _accepted(_input, inputs, rejected):
        paths.setdefault(name, []).append(str(place))
    given = [Override(("inputs", name), places, f"--input {name}") for name, places in paths.items()]
    origins = Origins(path, lines, [(override.key, override.where) for override in (*overrides, *given)])
    errors = ValidationErrors(origins, rejected)
    overrides += _declared(given, written.get("inputs"), errors)
    return reduce(overridden, overrides, written), errors


def _declared(given: list[Override], declared: Any, errors: ValidationErrors) -> list[Override]:
    """Return those of the inputs that the file declares; the others are errors."""
    known = declared if isinstance(declared, dict) else {}
    for override in given:
        name = override.key[1]
        if name not in known:
            hint = suggestion(name, known) or "; the recipe has no inputs"
            errors.add(override.key, f"unknown input '{name}'{hint}")
    return [override for override in given if override.key[1] in known]


def _accepted(
    parse: Callable[[Given], Parsed], texts: Iterable[Given], rejected: list[ConfigurationError]
) -> list[Parsed]:
    """Parse what can be parsed and collect the errors about the rest."""
    parsed = []
    for text in texts:
        try:
            parsed.append(parse(text))
        except ConfigurationError as error:
            rejected.append(error)
    return parsed


def _input(text: str) -> tuple[str, Path]:
    """Name and path of ``NAME=PATH``; the path counts from the current folder."""
    name, equals, path = text.partition("=")
    if not (equals and name.strip() and path):
        raise ConfigurationError(
            f"--input {text}: expected NAME=PATH, for example calibration=data/2023-07-14"
        )
    return name.strip(), absolute(path)


def absolute(path: str | Path, folder: Path | None = None) -> Path:
    """Return an absolute `path`, counted from `folder`; links are kept, as their names carry meaning."""
    expanded = Path(os.path.expanduser(path))  # which leaves ~ where there is no home
    return Path(os.path.abspath(expanded if folder is None else folder / expanded))


def overridden(data: Any, override: Override) -> dict:
    """Return `data` with the value of `override` in it; missing levels are made, `data` stays as it is."""
    key, *below = override.key
    if data is not None and not isinstance(data, dict):
        raise ConfigurationError(f"{override.where}: there is a plain value, no section, above '{key}'")
    here = data or {}
    inner = replace(override, key=tuple(below))
    return {**here, key: overridden(here.get(key), inner) if below else override.value}


def _yaml_value(text: str, where: str) -> Any:
    # Parsed as a one-key document, so that a value means what it means in a recipe.
    try:
        return parse_yaml(f"value: {text}\n", where)[0]["value"]
    except ConfigurationError as error:
        problem = str(error).partition("not valid YAML: ")[2] or str(error)
        raise ConfigurationError(f"{where}: the value {text!r} is not valid YAML: {problem}") from None
