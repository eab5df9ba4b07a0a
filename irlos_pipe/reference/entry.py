"""One thing that can be explained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["stage", "key of a recipe", "key of a side-car", "effect", "check", "number"]


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
        return f".{self.name}".endswith(f".{name}")
