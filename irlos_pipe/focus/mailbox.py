"""The offset of the focus, where the telescope finds it: one small file, overwritten in place.

Its size never changes, so that a full disk does not keep the loop from commanding, and it outlives both
sides: the last good command stands in it whatever happens to the loop.

Layout, little-endian: magic ``IRLOSCMD``, number of the command from 1 (uint64), offset [nm RMS] (float64),
counter of the first read of the exposure behind it (int64), CRC-32 of these (uint32).
"""

import math
import os
import struct
import zlib
from pathlib import Path
from typing import NamedTuple

from irlos_pipe.conventions.errors import InputDataError

MAGIC = b"IRLOSCMD"
BODY = struct.Struct("<8sQdq")
CRC = struct.Struct("<I")
SIZE = BODY.size + CRC.size
ATTEMPTS = 100  # to read before the file counts as damaged


class Command(NamedTuple):
    """What the telescope is to apply: `number` from 1, `offset_nm`, `counter` of the exposure behind it."""

    number: int
    offset_nm: float
    counter: int


class Mailbox:
    """The file with the last command, made if it does not exist; `damaged` if what stood there is no command.

    Raises `InputDataError` if there is another file.
    """

    def __init__(self, path: Path):
        self.path = path
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK
        try:
            self._descriptor = os.open(path, flags, 0o644)
            content = os.pread(self._descriptor, SIZE, 0)
        except OSError as error:
            raise InputDataError(f"{path}: cannot be opened: {error.strerror}; remove it") from None
        if not content:
            self._write(Command(0, 0.0, 0))
        elif not content.startswith(MAGIC):
            self.close()
            raise InputDataError(
                f"{path}: not the command of a focus loop; remove it or choose another output"
            )
        self.damaged = bool(content) and _command(content) is None

    def write(self, command: Command) -> None:
        """Replace the command.

        Raises `ValueError` if its offset is no finite number: the telescope could do nothing with it.
        """
        if not math.isfinite(command.offset_nm):
            raise ValueError(f"an offset of {command.offset_nm} nm")
        self._write(command)

    def read(self) -> Command | None:
        """Return the last command; None before the first, or if the file is damaged."""
        for _ in range(ATTEMPTS):  # a reader may come while the file is being written
            command = _command(os.pread(self._descriptor, SIZE, 0))
            if command is not None:
                return command if command.number else None
        return None

    def close(self) -> None:
        os.close(self._descriptor)

    def _write(self, command: Command) -> None:
        body = BODY.pack(MAGIC, *command)
        os.pwrite(self._descriptor, body + CRC.pack(zlib.crc32(body)), 0)


def _command(content: bytes) -> Command | None:
    """What stands in the file; None if it is damaged."""
    body = content[: BODY.size]
    if len(content) < SIZE or CRC.unpack_from(content, BODY.size)[0] != zlib.crc32(body):
        return None
    command = Command(*BODY.unpack(body)[1:])
    return command if math.isfinite(command.offset_nm) else None
