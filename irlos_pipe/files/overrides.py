"""Values of a settings file that the command line replaces: ``--set KEY=VALUE``, ``--input NAME=PATH``."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any, TypeVar

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.validation import Origins, ValidationErrors
from irlos_pipe.files.yaml import load_yaml, parse_yaml

Parsed = TypeVar("Parsed")
Given = TypeVar("Given")
EXAMPLE = "stage.key=VALUE, for example calibrate.method=dip_avg"


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
    comes from.

    Parameters
    ----------
    parse : callable
        Makes an override of one of the `settings`.
    settings : iterable
        ``key.key=VALUE`` or what else `parse` takes, applied in order; the value is YAML.
    inputs : iterable of str
        ``NAME=PATH``, relative to the current folder; a name given again makes a list.
    seed : int, optional
        Replaces the value of ``seed``.
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
