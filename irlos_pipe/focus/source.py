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
    reads : int
        That it stands for.
    """

    text: str
    reads: int = 1


@dataclass(frozen=True)
class Notice:
    """Something that happened to the source itself.

    Attributes
    ----------
    text : str
        What happened and where, in one line.
    counts_anew : bool
        Whether the counter of the reads after it may begin anywhere.
    """

    text: str
    counts_anew: bool = False


Arrival = Read | Fault | Notice


class Source(Protocol):
    """Where reads come from.

    It may say how its frames were taken, as far as it knows from the start: `window`, `acquisition` and
    `instrument_name`, as a calibration has them.
    """

    def poll(self, timeout_s: float) -> Sequence[Arrival] | None:
        """Return what has arrived, waiting for up to `timeout_s`; None when nothing will come any more."""

    def close(self) -> None:
        """Let go of files and memory."""
