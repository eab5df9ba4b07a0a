"""Values of a settings file that the command line replaces: ``--set KEY=VALUE``, ``--input NAME=PATH``."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any, TypeVar

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.validation import Origins, ValidationErrors
from irlos_pipe.files.yaml import load_yaml, parse_yaml

Parsed = TypeVar("Parsed")
EXAMPLE = "stage.key=VALUE, for example calibrate.method=dip_avg"


@dataclass(frozen=True)
class Override:
    """One value that replaces the file's.

    Attributes
    ----------
    key : tuple of str or int
        Key path, for example ``("calibrate", "method")``.
    where : str
        What error messages name, for example ``--set calibrate.method``.
    """

    key: tuple[str | int, ...]
    value: Any
    where: str


def parse_setting(text: str, example: str = EXAMPLE) -> Override:
    """Parse the `text` ``stage.key=VALUE``, the value in YAML; `example` is what the error asks for.

    Raises
    ------
    ConfigurationError
        When there is no ``=``, no key, or the value is not YAML.
    """
    dotted, equals, value = text.partition("=")
    parts = dotted.strip().split(".")
    if not equals or not all(parts):
        raise ConfigurationError(f"--set {text}: expected {example}")
    where = f"--set {dotted.strip()}"
    return Override(tuple(map(_key_part, parts)), _yaml_value(value, where), where)


def read_overridden(
    path: Path,
    parse: Callable[[str], Override],
    settings: Iterable[str] = (),
    inputs: Iterable[str] = (),
    seed: int | None = None,
) -> tuple[dict, ValidationErrors]:
    """Read a settings file and replace what the command line gives.

    Parameters
    ----------
    path : Path
        The YAML file.
    parse : callable
        Makes an override of one of the `settings`.
    settings : iterable of str
        ``key.key=VALUE``, applied in order; the value is YAML.
    inputs : iterable of str
        ``NAME=PATH``, relative to the current folder; a name given again makes a list.
    seed : int, optional
        Replaces the value of ``seed``.

    Returns
    -------
    data : dict
        Content of the file with the replaced values.
    errors : ValidationErrors
        What was wrong with the options, and where every value comes from.
    """
    written, lines = load_yaml(path)
    rejected: list[ConfigurationError] = []
    overrides = _accepted(parse, settings, rejected)
    overrides += [] if seed is None else [Override(("seed",), seed, "--seed")]
    given = input_overrides(_accepted(parse_input, inputs, rejected))
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
    parse: Callable[[str], Parsed], texts: Iterable[str], rejected: list[ConfigurationError]
) -> list[Parsed]:
    """Parse what can be parsed and collect the errors about the rest."""
    parsed = []
    for text in texts:
        try:
            parsed.append(parse(text))
        except ConfigurationError as error:
            rejected.append(error)
    return parsed


def parse_input(text: str) -> tuple[str, Path]:
    """Parse ``NAME=PATH``; the path counts from the current folder.

    Raises
    ------
    ConfigurationError
        When name or path is missing.
    """
    name, equals, path = text.partition("=")
    if not (equals and name.strip() and path):
        raise ConfigurationError(
            f"--input {text}: expected NAME=PATH, for example calibration=data/2023-07-14"
        )
    return name.strip(), absolute(path)


def input_overrides(pairs: Iterable[tuple[str, Path]]) -> list[Override]:
    """Return one override per input name; a name given more than once makes a list."""
    collected: dict[str, list[str]] = {}
    for name, path in pairs:
        collected.setdefault(name, []).append(str(path))
    return [Override(("inputs", name), paths, f"--input {name}") for name, paths in collected.items()]


def absolute(path: str | Path, folder: Path | None = None) -> Path:
    """Return an absolute `path`, counted from `folder`; links are kept, as their names carry meaning."""
    expanded = Path(os.path.expanduser(path))  # which leaves ~ where there is no home
    return Path(os.path.abspath(expanded if folder is None else folder / expanded))


def overridden(data: Any, override: Override) -> dict:
    """Return `data` with the value of `override` in it; missing levels are made, `data` stays as it is."""
    return _replaced(data, override.key, override)


def _replaced(data: Any, key: tuple, override: Override) -> Any:
    if not key:
        return override.value
    if data is not None and not isinstance(data, dict):
        raise ConfigurationError(f"{override.where}: there is a plain value, no section, above '{key[0]}'")
    here = data or {}
    return {**here, key[0]: _replaced(here.get(key[0]), key[1:], override)}


def _key_part(text: str) -> str | int:
    return int(text) if text.isdecimal() else text


def _yaml_value(text: str, where: str) -> Any:
    # Parsed as a one-key document, so that a value means what it means in a recipe.
    try:
        return parse_yaml(f"value: {text}\n", where)[0]["value"]
    except ConfigurationError as error:
        problem = str(error).partition("not valid YAML: ")[2] or str(error)
        raise ConfigurationError(f"{where}: the value {text!r} is not valid YAML: {problem}") from None
