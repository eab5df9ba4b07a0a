"""The time of day for a loop that must not trust a clock that may be set."""

from __future__ import annotations

import time
from dataclasses import dataclass, field


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
