"""A limit on memory, and a witness of every file that is opened for writing."""

import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from irlos_pipe.commands import night

GIB = 2**30
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGING = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.truncate", "shutil.rmtree"}
_seen: list[str] | None = None
_installed = False


@contextmanager
def limited_memory(size: int) -> Iterator[None]:
    """Let the process take no more than `size` bytes of address space beyond what it has."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@contextmanager
def witnessed_writes() -> Iterator[list[str]]:
    """Collect the paths of all that Python code creates, changes or removes in the block."""
    global _seen, _installed
    if not _installed:  # a hook cannot be taken out again
        sys.addaudithook(_witness)
    _seen, _installed = [], True
    try:
        yield _seen
    finally:
        _seen = None


def _witness(event: str, arguments: tuple) -> None:
    if _seen is None or not (_opens_for_writing(event, arguments) or event in CHANGING):
        return
    path = arguments[0]
    # a name relative to an open folder belongs to shutil.rmtree, which is an event of its own
    if isinstance(path, (str, bytes, os.PathLike)) and (event == "open" or os.path.isabs(path)):
        _seen.append(os.path.abspath(os.fsdecode(path)))


def _opens_for_writing(event: str, arguments: tuple) -> bool:
    return event == "open" and isinstance(arguments[2], int) and bool(arguments[2] & WRITING)


@contextmanager
def nights_in_this_process() -> Iterator[None]:
    """Nights without worker processes, whose limits nobody here would see."""
    with patch.object(night, "_runner", lambda *_: lambda work, tasks: map(work, tasks)):
        yield
