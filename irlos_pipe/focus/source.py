"""What the loop reads frames from, and the clocks by which it judges their times.

A new kind of source is a class with the two methods of `Source`.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from irlos_pipe.control.exposures import Read


@dataclass(frozen=True)
class Fault:
    """What came in place of so many `reads`: what is wrong and where, in one line."""

    text: str
    reads: int = 1


@dataclass(frozen=True)
class Notice:
    """What happened to the source itself, in one line; whether counters after it may begin anywhere."""

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


@dataclass(frozen=True)
class Clock:
    """Two clocks: that of the machine, and what it showed at the start with the time that has passed since.

    When the machine's clock is set, forwards or back, one of the two agrees with the recorder's.
    """

    _began_s: float = field(default_factory=lambda: time.time() - time.monotonic())

    def ahead_s(self, unix_s: float) -> float:
        """Return by how much a time is ahead of both; NaN if it is not known."""
        return unix_s - max(time.time(), self._began_s + time.monotonic())

    def off_s(self, unix_s: float) -> float:
        """Return by how much a time is off the nearer one, either way; NaN if it is not known."""
        return min(abs(unix_s - time.time()), abs(unix_s - self._began_s - time.monotonic()))
