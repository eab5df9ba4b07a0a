"""Python and numpy values as strict JSON: NaN and infinity become null, keys become text."""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import PurePath
from typing import Any

import numpy as np
from pydantic import BaseModel


def jsonable(value: Any) -> Any:
    """Return `value` in the types JSON has; `TypeError` for objects that have no JSON form."""
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, (np.generic, np.ndarray)):
        return jsonable(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [jsonable(item) for item in value]
    if isinstance(value, (set, frozenset)):
        return sorted(jsonable(item) for item in value)
    if isinstance(value, BaseModel):
        return jsonable(value.model_dump())
    if is_dataclass(value) and not isinstance(value, type):
        # what does not count in comparisons says nothing that the other fields do not
        return {field.name: jsonable(getattr(value, field.name)) for field in fields(value) if field.compare}
    if isinstance(value, PurePath):
        return str(value)
    raise TypeError(f"{type(value).__name__} has no JSON form")


def json_text(value: Any, indent: int | None = 1) -> str:
    """Return `value` as strict JSON with a final newline, `indent` spaces per level."""
    return json.dumps(jsonable(value), indent=indent, allow_nan=False, ensure_ascii=False) + "\n"


def canonical_json(value: Any) -> str:
    """Serialise so that equal content gives equal text, whatever the order of keys."""
    return json.dumps(jsonable(value), sort_keys=True, separators=(",", ":"), allow_nan=False)


def changed_values(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[tuple[str, ...], tuple[Any, Any]]:
    """Return `old` and `new` value, by key path, of all in which two nested mappings differ.

    What is absent counts as None. They are in the order of `new`; what that lacks comes last.
    """
    before, after = dict(flat(old)), dict(flat(new))
    both = {name: (before.get(name), after.get(name)) for name in after | before}
    return {name: values for name, values in both.items() if values[0] != values[1]}


def flat(tree: Mapping[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield what is no mapping, or an empty one, in nested mappings, with its key path, from `above` on."""
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            yield from flat(value, (*above, key))
        else:
            yield (*above, key), value
