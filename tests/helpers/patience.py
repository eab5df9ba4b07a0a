"""Tests of what once hung forever: they fail instead."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager


class Hang(BaseException):
    """No ``except Exception`` of the code under test stops it."""


@contextmanager
def within(seconds: int) -> Iterator[None]:
    """Raise `Hang` in the block after so many seconds."""

    def stop(*_: object) -> None:
        raise Hang(f"not done within {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
