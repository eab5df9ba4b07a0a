"""How much memory is free, asked before work begins that needs much of it."""

from __future__ import annotations

import os
import re
from pathlib import Path

from irlos_pipe.conventions.errors import IrlosError

GB = 1e9


def require_memory(needed_bytes: float, what: str, error: type[IrlosError], advice: str) -> None:
    """Refuse work for which the memory of this machine does not suffice.

    Parameters
    ----------
    needed_bytes : float
        What the work takes.
    what : str
        Begins the message; `advice` ends it.
    error : subclass of IrlosError
        Raised when less is free.
    """
    free = available_bytes()
    if needed_bytes > free:
        raise error(
            f"{what}: needs about {needed_bytes / GB:.1f} GB of memory, {free / GB:.1f} are free; {advice}"
        )


def available_bytes() -> float:
    """Return the memory [bytes] that a new program can have without swapping; infinite if not known."""
    try:
        found = re.search(r"MemAvailable: +([0-9]+) kB", Path("/proc/meminfo").read_text())
        if found:
            return 1024.0 * int(found[1])
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (OSError, ValueError):
        return float("inf")
