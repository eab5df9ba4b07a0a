"""A limit on the time that something may take, also where it hangs inside a library."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

GRACE_S = 30.0  # how much later a process of our own is killed that does not even hear of it


class TookTooLong(BaseException):
    """Something took longer than it may; no `except Exception` on the way takes it for its own problem."""


@contextmanager
def time_limit(seconds: float, what: str, *, kill: bool = False) -> Iterator[None]:
    """Stop the block after so many `seconds`.

    An alarm of the system interrupts it, reads and waits included. Python hears of it between two of its
    own steps: what hangs inside a library, or in a disk that does not answer, can only be killed with its
    process. Alarms belong to the main thread; elsewhere there is no limit.

    Parameters
    ----------
    seconds : float
        No limit if 0.
    what : str
        Begins the message.
    kill : bool
        Kill this process, a worker, if it has not ended half a minute later.

    Raises
    ------
    TookTooLong
        After that time.
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
