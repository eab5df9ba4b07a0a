"""Tests of what once hung forever: they fail instead."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager


class Hang(BaseException):
    """No ``except Exception`` of the code under test stops it."""


@contextmanager
def within(seconds: float, patience: int = 1) -> Iterator[None]:
    """Raise `Hang` in the block after so many seconds of the processor, or `patience` times that in all."""

    def stop(*_: object) -> None:
        raise Hang(f"not done within {seconds} s")

    limits = {signal.ITIMER_PROF: seconds, signal.ITIMER_REAL: patience * seconds}
    before = {number: signal.signal(number, stop) for number in (signal.SIGPROF, signal.SIGALRM)}
    for timer, limit in limits.items():
        signal.setitimer(timer, limit)
    try:
        yield
    finally:
        for timer in limits:
            signal.setitimer(timer, 0)
        for number, handler in before.items():
            signal.signal(number, handler)
