"""Files appear whole or not at all: written next to their target, flushed to disk, then renamed.

And file systems without locks: many network disks are mounted without, and answer each in its own way.
"""

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import BinaryIO

from irlos_pipe.conventions.errors import IrlosError

TEMPORARY_SUFFIX = ".part"
ENOTSUPP = 524  # of NFS: the kernel's own, which Python has no name for
UNSUPPORTED = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, ENOTSUPP}


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file that becomes `path` when the block ends without an exception.

    Raises `IrlosError` when the file cannot be written (disk full, no permission); nothing is left behind.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}{TEMPORARY_SUFFIX}")
    try:
        with open(temporary, "wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
        # the rename itself survives a power cut
        handle = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        raise IrlosError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes | memoryview) -> None:
    """Write a whole file with this `content` to `path` atomically."""
    with atomic_file(path) as stream:
        stream.write(content)


def write_if_changed(path: Path, content: bytes) -> bool:
    """Write `content` to `path` unless it stands there already; return whether it was written."""
    if path.is_file() and path.read_bytes() == content:
        return False
    write_bytes(path, content)
    return True


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files of a run that was killed (only safe for the owner of the folder)."""
    for leftover in folder.glob(f".*{TEMPORARY_SUFFIX}"):
        leftover.unlink(missing_ok=True)


def has_locks(folder: Path) -> bool:
    """Return whether files in a `folder` can be locked; True as well where no file can be made to try it."""
    try:
        with NamedTemporaryFile(dir=folder, prefix=".lock.", suffix=TEMPORARY_SUFFIX) as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            fcntl.flock(file, fcntl.LOCK_UN)  # a network disk may take the next one for the same lock
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in UNSUPPORTED
    return True
