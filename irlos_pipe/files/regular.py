"""Open regular files only: a pipe would block for ever, a device may never end."""

from __future__ import annotations

import errno
import os
import stat
from io import BufferedReader
from pathlib import Path


def open_regular(path: str | Path) -> BufferedReader:
    """Open the file at `path` for reading; links are followed.

    Raises
    ------
    OSError
        When it cannot be opened, or is a folder, pipe, socket or device.
    """
    return open(path, "rb", opener=_opened)


def read_regular(path: str | Path) -> str:
    """Return the text, in UTF-8, of the file at `path`.

    Raises
    ------
    OSError
        As `open_regular`.
    UnicodeDecodeError
        When it is not UTF-8.
    """
    with open_regular(path) as stream:
        return stream.read().decode()


def own_file(path: str, flags: int) -> int:
    """Open a file of our own, as `opener` of `open`: no link is followed, only a file is written to."""
    if os.path.islink(path):
        raise OSError(errno.ELOOP, "a link, which is not followed; remove it", path)
    return _regular(os.open(path, flags | os.O_NONBLOCK | os.O_NOFOLLOW, 0o666), path)


def _opened(path: str, flags: int) -> int:
    return _regular(os.open(path, flags | os.O_NONBLOCK), path)


def _regular(descriptor: int, path: str) -> int:
    # Without O_NONBLOCK the opening itself would have waited for the other end of a pipe.
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return descriptor
    os.close(descriptor)
    code = errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL
    raise OSError(code, "is a folder" if stat.S_ISDIR(mode) else "not a regular file", path)
