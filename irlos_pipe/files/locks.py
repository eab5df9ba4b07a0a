"""File systems without locks: many network disks are mounted without, and answer each in its own way."""

from __future__ import annotations

import errno
import fcntl
from pathlib import Path
from tempfile import NamedTemporaryFile

from irlos_pipe.files.atomic import TEMPORARY_SUFFIX

ENOTSUPP = 524  # of NFS: the kernel's own, which Python has no name for
UNSUPPORTED = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, ENOTSUPP}


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
