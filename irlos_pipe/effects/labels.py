"""Names that distinguish effects of the same kind in a model."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from irlos_pipe.effects.base import Effect


def occurrences(names: Iterable[str]) -> list[int]:
    """How many of the same name come before each of `names`."""
    seen: Counter[str] = Counter()
    found = []
    for name in names:
        found.append(seen[name])
        seen[name] += 1
    return found


def labels_of(effects: Sequence[Effect]) -> list[str]:
    """Unique labels of `effects` in this order: the name, and of a second of its kind ``name_2``."""
    names = [effect.name for effect in effects]
    return [label_of(name, before) for name, before in zip(names, occurrences(names), strict=True)]


def label_of(name: str, before: int) -> str:
    """Label of an effect with this `name` of which there are some `before` it."""
    return f"{name}_{before + 1}" if before else name
