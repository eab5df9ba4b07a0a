"""Of many faults some are told, and then how many more there were."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

MOST_A_MINUTE = 20
MINUTE_S = 60.0


@dataclass
class SparingNotes:
    """Passes faults on, each one up to a number per minute, then only how many there were.

    Attributes
    ----------
    tell : callable
        Gets the lines.
    """

    tell: Callable[[str], None]
    _began_s: float = field(default_factory=time.monotonic)
    _told: int = 0
    _untold: int = 0
    _last: str = ""

    def add(self, text: str) -> None:
        """Tell a fault, or count it.

        Parameters
        ----------
        text : str
            Of one line.
        """
        self.look()
        if self._told < MOST_A_MINUTE:
            self._told += 1
            self.tell(text)
        else:
            self._untold, self._last = self._untold + 1, text

    def look(self) -> None:
        """Tell at the end of a minute how many were not told."""
        if time.monotonic() - self._began_s >= MINUTE_S:
            self.finish()
            self._began_s, self._told = time.monotonic(), 0

    def finish(self) -> None:
        """Tell how many were not told yet."""
        if self._untold:
            self.tell(f"{self._untold} more faults, the last: {self._last}")
        self._untold = 0
