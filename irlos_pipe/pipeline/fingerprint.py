"""The key of a product: a checksum of everything it depends on, and the words for what changed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from irlos_pipe.files.json import canonical_json, jsonable
from irlos_pipe.pipeline.inputs import InputFile
from irlos_pipe.recipe import Recipe
from irlos_pipe.stages.base import Stage, depends_on

MAX_REASONS = 3


def key_parts(
    stage: Stage, recipe: Recipe, files: Iterable[InputFile], upstream: Mapping[str, str]
) -> dict[str, Any]:
    """Return all that the product of `stage` depends on, in JSON types.

    Parameters
    ----------
    upstream : mapping of str to str
        Keys of the products that the stage reads.
    """
    parts = {
        "model": recipe.model,
        "instrument": recipe.instrument,
        "seed": recipe.seed,
        "inputs": {file.label: file.sha256 for file in files},
    }
    own = {
        "stage": stage.NAME,
        "version": stage.VERSION,
        "config": recipe.configs[stage.NAME],
        "upstream": dict(upstream),
    }
    return jsonable(own | {name: parts[name] for name in sorted(depends_on(stage))})


def key_of(parts: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the parts, whatever their order."""
    return hashlib.sha256(canonical_json(parts).encode()).hexdigest()


def changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Say what differs between the parts of two keys, the first few differences in full."""
    reasons = list(_differences(old, new))
    shown = reasons[:MAX_REASONS]
    more = len(reasons) - len(shown)
    return "; ".join(shown) + (f"; and {more} more" if more else "")


def _differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    before, after = dict(_flat(old)), dict(_flat(new))
    for name in after | before:
        if before.get(name) != after.get(name):  # what is absent counts as null
            yield _told(name, str(new["stage"]), before, after)


def _flat(tree: Mapping[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, (*above, key))
        else:
            yield (*above, key), value


def _told(name: tuple[str, ...], stage: str, before: Mapping, after: Mapping) -> str:
    part, rest = name[0], ".".join(name[1:])
    if part == "inputs":
        return f"input file {rest} {_fate(name, before, after)}"
    if part == "upstream":
        return f"upstream {rest} {_fate(name, before, after)}"
    label = {"config": f"{stage}.{rest}", "version": "stage version"}.get(part, ".".join(name))
    verb = "" if part == "version" else " changed"
    return f"{label}{verb} {_shown(before.get(name))} -> {_shown(after.get(name))}"


def _fate(name: tuple[str, ...], before: Mapping, after: Mapping) -> str:
    if name not in before:
        return "is new"
    return "changed" if name in after else "is gone"


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
