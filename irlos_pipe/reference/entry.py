"""One thing that can be explained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal[
    "stage",
    "key of a recipe",
    "key of a side-car",
    "key of a profile",
    "fact of a profile",
    "effect",
    "check",
    "number",
    "array of a product",
    "term",
]


@dataclass(frozen=True)
class Entry:
    """A name with its explanation.

    Attributes
    ----------
    name : str
        Where it stands, dotted: ``calibrate.method``.
    text : str
        What it means, in lines; the first is a summary.
    """

    kind: Kind
    name: str
    text: str

    @property
    def summary(self) -> str:
        """The first line of the explanation."""
        return self.text.partition("\n")[0]

    def is_called(self, name: str) -> bool:
        """Return whether `name` is the whole name, or a last part of it."""
        if self.kind == "term":
            return self.name.lower() == name.lower()
        return f".{self.name}".replace("/", ".").endswith(f".{name}".replace("/", "."))
