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


def kind_of(label: str) -> str:
    """Name of the effect with this `label`."""
    return _parts(label)[0]


def label_after(label: str, gone: str) -> str:
    """Label of an effect when the one labelled `gone` has left the model: later ones of its kind move up.

    Parameters
    ----------
    label, gone : str
    """
    (name, number), (other, place) = _parts(label), _parts(gone)
    return label_of(name, number - 1) if name == other and number > place else label


def _parts(label: str) -> tuple[str, int]:
    """The name in a label, and how many of its kind come before."""
    name, _, number = label.rpartition("_")
    return (name, int(number) - 1) if name and number.isdecimal() else (label, 0)
