"""Results of a run as single values with their errors, under names that are the same in another run."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

# Values whose errors stand under another name than NAME_sigma, NAME_sigma_UNIT or NAME_error_UNIT.
ERRORS = {
    "zernike_nm": "sigma_nm",
    "defocus_nm": "sigma_nm",
    "ncpa_change_nm": "sigma_nm",
    "parameters": "sigma",
    "shown": "shown_sigma",
    "measured": "error",
}
CALLED = ("name", "recording", "effect", "method")  # what a row of a list is called by; `frame` tells on
Path = tuple[str, ...]
OF_THE_MACHINE = {"seconds"}  # differs between any two runs


@dataclass(frozen=True)
class Leaf:
    """A single value, and its error, NaN without one."""

    value: Any
    error: float = math.nan


def leaves(
    tree: Any, error: Any = None, above: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Leaf]]:
    """Yield the path and the value of every leaf of results in the types of JSON.

    Parameters
    ----------
    tree : any
        Results.
    error : any
        Errors in the same form, or None.
    above : tuple of str
        Path of the tree itself.

    Notes
    -----
    A row of a list is named by what it is called, not by its number, so that rows of two runs are matched by
    what they are of. Numbers of a list go by their place; a list of anything else is one value.
    """
    if isinstance(tree, Mapping):
        for key, value in tree.items():
            if key not in _error_keys(tree) | OF_THE_MACHINE:
                yield from leaves(value, _error_of(key, tree, error), (*above, str(key)))
    elif isinstance(tree, list) and tree and all(isinstance(row, Mapping) for row in tree):
        for name, row in zip(_names(tree), tree, strict=True):
            yield from leaves(row, None, (*above, name))
    elif isinstance(tree, list) and tree and all(map(is_number, tree)):
        errors = error if isinstance(error, list) and len(error) == len(tree) else [None] * len(tree)
        for index, (value, its_error) in enumerate(zip(tree, errors, strict=True)):
            yield from leaves(value, its_error, (*above, str(index)))
    else:
        yield above, Leaf(tree, float(error) if is_number(error) and is_number(tree) else math.nan)


def is_number(value: Any) -> bool:
    """Return whether a value of JSON is a number; switches are none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _error_of(key: str, tree: Mapping[str, Any], error: Any) -> Any:
    """The error of a value of a tree: beside it, or in the tree of errors."""
    if isinstance(error, Mapping):
        return error.get(key)
    return next(
        (tree[name] for name in _candidates(key) if name in tree and _fits(tree[key], tree[name])), None
    )


def _error_keys(tree: Mapping[str, Any]) -> set[str]:
    """Keys of a tree that hold the errors of others."""
    return {
        name
        for key, value in tree.items()
        for name in _candidates(key)
        if name in tree and _fits(value, tree[name])
    }


def _candidates(key: str) -> Iterator[str]:
    """Keys that the error of a key may stand under."""
    stem, _, unit = key.rpartition("_")
    yield from (ERRORS[key],) if key in ERRORS else ()
    yield f"{key}_sigma"
    yield from (f"{stem}_sigma_{unit}", f"{stem}_error_{unit}") if stem else ()


def _fits(value: Any, error: Any) -> bool:
    return isinstance(value, Mapping) == isinstance(error, Mapping)


def _names(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """A name of its own for every row of a list: what it is called, or its number."""
    called = [_called(row) for row in rows]
    counted = Counter(called)
    return [name if name and counted[name] == 1 else str(index) for index, name in enumerate(called)]


def _called(row: Mapping[str, Any]) -> str:
    name = next((str(row[key]) for key in CALLED if isinstance(row.get(key), str)), "")
    return f"{name}[{row['frame']}]" if name and "frame" in row else name
