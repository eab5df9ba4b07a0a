"""Limits: on the time that something may take, also where it hangs inside a library, and on its memory."""

from __future__ import annotations

import os
import re
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from irlos_pipe.conventions.errors import IrlosError

GRACE_S = 30.0  # how much later a process of our own is killed that does not even hear of it
GB = 1e9


class TookTooLong(BaseException):
    """Something took longer than it may; no `except Exception` on the way takes it for its own problem."""


@contextmanager
def time_limit(seconds: float, what: str, *, kill: bool = False) -> Iterator[None]:
    """Raise TookTooLong, with a message that begins with `what`, after so many `seconds`; never if 0.

    An alarm of the system interrupts the block, reads and waits included. Python hears of it between two of
    its own steps: what hangs inside a library, or in a disk that does not answer, can only be killed with its
    process. With `kill` this process, a worker, is, if it has not ended half a minute later. Alarms belong to
    the main thread; elsewhere there is no limit.
    """
    if seconds <= 0 or threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise TookTooLong(f"{what}: took longer than {seconds / 60:.3g} min and was stopped")

    before = signal.signal(signal.SIGALRM, stop)
    killer = threading.Timer(seconds + GRACE_S, os.kill, (os.getpid(), signal.SIGKILL))
    killer.daemon = True
    if kill:
        killer.start()
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        killer.cancel()


def require_memory(needed_bytes: float, what: str, error: type[IrlosError], advice: str) -> None:
    """Raise an `error`, from `what` to `advice`, when less memory than `needed_bytes` is free."""
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
