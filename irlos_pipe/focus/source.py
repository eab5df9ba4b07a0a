"""What the loop reads frames from; a new kind of source is a class with these two methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from irlos_pipe.control.exposures import Read


@dataclass(frozen=True)
class Fault:
    """Something that came in place of a read.

    Attributes
    ----------
    text : str
        What is wrong and where, in one line.
    """

    text: str


class Source(Protocol):
    """Where reads come from."""

    def poll(self, timeout_s: float) -> Sequence[Read | Fault] | None:
        """Return what has arrived, waiting for up to `timeout_s`; None when nothing will come any more."""

    def close(self) -> None:
        """Let go of files and memory."""
