"""The key of a product: a checksum of everything it depends on, and the description of what changed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any

from irlos_pipe.files.json import canonical_json, changed_values, jsonable
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
    stage : Stage
        The module of the stage.
    recipe : Recipe
        Its configuration, model, instrument and seed are parts.
    files : iterable of InputFile
        Files of the inputs.
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
    """Describe how the parts of two keys, `old` and `new`, differ; the first few differences in full."""
    stage = str(new["stage"])
    reasons = [_difference(name, stage, *values) for name, values in changed_values(old, new).items()]
    more = len(reasons) - MAX_REASONS
    return "; ".join(reasons[:MAX_REASONS]) + (f"; and {more} more" if more > 0 else "")


def _difference(name: tuple[str, ...], stage: str, before: Any, after: Any) -> str:
    part, rest = name[0], ".".join(name[1:])
    if part in ("inputs", "upstream"):
        verb = "is new" if before is None else "is gone" if after is None else "changed"
        return f"{'input file' if part == 'inputs' else part} {rest} {verb}"
    label = {"config": f"{stage}.{rest}", "version": "stage version"}.get(part, ".".join(name))
    verb = "" if part == "version" else " changed"
    return f"{label}{verb} {_shown(before)} -> {_shown(after)}"


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
