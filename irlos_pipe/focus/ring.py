"""A ring of frames in shared memory, between the program that reads the detector and the loop.

It is a file, in /dev/shm or elsewhere, that both sides map. Either side may be killed and started again:
the writer goes on where the file stands, and a reader sees whatever has not been overwritten. A slot is
checked by its number and a checksum, so that a half-written frame is never taken for a whole one.

Layout, little-endian: a head of 64 bytes (magic ``IRLOSRNG``, version, rows, columns, slots as uint32; number
of frames written so far as uint64 at byte 24), then the slots: number of the frame from 1 (uint64), counter
(int64), time (float64), CRC-32 of counter, time and pixels (uint32), 4 bytes of padding, pixels (float32, x
fastest), photo-electrons without dark and background.
"""

from __future__ import annotations

import mmap
import os
import struct
import time
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from irlos_pipe.control.exposures import Read
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.focus.source import Fault

MAGIC, VERSION = b"IRLOSRNG", 1
HEAD = struct.Struct("<8s4I")
HEAD_BYTES, WRITTEN_AT = 64, 24
NUMBER = struct.Struct("<Q")
BODY = struct.Struct("<qdI4x")
POLL_S = 0.0005
LARGEST_SIDE = 4096


class _Ring:
    """The mapped file."""

    def __init__(self, path: Path, window: tuple[int, int], slots: int, *, writes: bool):
        self.path, self.window, self.slots = path, window, slots
        self._bytes = 4 * window[0] * window[1]
        self._stride = NUMBER.size + BODY.size + self._bytes
        descriptor = os.open(path, os.O_RDWR if writes else os.O_RDONLY)
        access = mmap.ACCESS_WRITE if writes else mmap.ACCESS_READ
        self._map = mmap.mmap(descriptor, HEAD_BYTES + slots * self._stride, access=access)
        os.close(descriptor)

    @property
    def written(self) -> int:
        """Frames written so far."""
        return int(NUMBER.unpack_from(self._map, WRITTEN_AT)[0])

    def close(self) -> None:
        """Unmap the file."""
        self._map.close()

    def _at(self, number: int) -> int:
        return HEAD_BYTES + (number - 1) % self.slots * self._stride


class RingWriter(_Ring):
    """Writes frames.

    Parameters
    ----------
    path : Path
        An existing ring of the same shape is continued, any other file there is refused.
    window : (int, int)
        Rows and columns.
    slots : int
        Frames kept.

    Raises
    ------
    InputDataError
        If the file is no ring of this shape.
    OSError
        If it cannot be made.
    """

    def __init__(self, path: Path, window: tuple[int, int], slots: int = 64):
        if not path.exists():
            _create(path, window, slots)
        found = _shape(path)
        if found != (*window, slots):
            raise InputDataError(
                f"{path}: a ring of {found[2]} frames of {found[0]}x{found[1]} px, not of {slots} of "
                f"{window[0]}x{window[1]}; remove it or choose another file"
            )
        super().__init__(path, window, slots, writes=True)

    def write(self, read: Read, *, damaged: bool = False) -> None:
        """Write one frame, `read`, over the oldest; a `damaged` one, for trials, has a wrong checksum."""
        number = self.written + 1
        at, pixels = self._at(number), np.ascontiguousarray(read.image_e, "<f4").tobytes()
        NUMBER.pack_into(self._map, at, 0)
        crc = _crc(read.counter, read.unix_s, pixels) ^ damaged
        BODY.pack_into(self._map, at + NUMBER.size, read.counter, read.unix_s, crc)
        self._map[at + NUMBER.size + BODY.size : at + self._stride] = pixels
        NUMBER.pack_into(self._map, at, number)
        NUMBER.pack_into(self._map, WRITTEN_AT, number)


class RingSource(_Ring):
    """Reads frames, see `Source`; begins with the oldest that is still there.

    Parameters
    ----------
    path : Path

    Raises
    ------
    InputDataError
        If the file is no ring.
    """

    def __init__(self, path: Path):
        rows, columns, slots = _shape(path)
        super().__init__(path, (rows, columns), slots, writes=False)
        self._next = max(1, self.written - slots + 2)

    def poll(self, timeout_s: float) -> Sequence[Read | Fault]:
        """See `Source.poll`."""
        until = time.monotonic() + timeout_s
        while self.written < self._next:
            if time.monotonic() >= until:
                return []
            time.sleep(POLL_S)
        found: list[Read | Fault] = []
        oldest = self.written - self.slots + 2
        if self._next < oldest:
            found.append(
                Fault(f"{self.path}: {oldest - self._next} frames overwritten before they were read")
            )
            self._next = oldest
        while self._next <= self.written:
            found.append(self._frame(self._next))
            self._next += 1
        return found

    def _frame(self, number: int) -> Read | Fault:
        at = self._at(number)
        slot = bytes(self._map[at : at + self._stride])
        counter, unix_s, crc = BODY.unpack_from(slot, NUMBER.size)
        pixels = slot[NUMBER.size + BODY.size :]
        if NUMBER.unpack_from(slot)[0] != number or crc != _crc(counter, unix_s, pixels):
            return Fault(f"{self.path}: frame {number} is damaged")
        return Read(counter, unix_s, np.frombuffer(pixels, "<f4").reshape(self.window))


def window_of(path: Path) -> tuple[int, int]:
    """Return rows and columns of the frames of the ring at `path`.

    Raises
    ------
    InputDataError
        If the file is no ring.
    """
    rows, columns, _ = _shape(path)
    return rows, columns


def _crc(counter: int, unix_s: float, pixels: bytes) -> int:
    return zlib.crc32(pixels, zlib.crc32(struct.pack("<qd", counter, unix_s)))


def _create(path: Path, window: tuple[int, int], slots: int) -> None:
    """Make an empty ring that appears whole."""
    size = HEAD_BYTES + slots * (NUMBER.size + BODY.size + 4 * window[0] * window[1])
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with open(temporary, "wb") as stream:
            stream.write(HEAD.pack(MAGIC, VERSION, *window, slots))
            stream.flush()
            os.posix_fallocate(stream.fileno(), 0, size)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _shape(path: Path) -> tuple[int, int, int]:
    """Rows, columns and slots of a ring."""
    try:
        with open(path, "rb") as stream:
            head, size = stream.read(HEAD.size), os.fstat(stream.fileno()).st_size
    except OSError as error:
        raise InputDataError(f"{path}: cannot be read as a ring of frames: {error.strerror}") from error
    if len(head) < HEAD.size or not head.startswith(MAGIC):
        raise InputDataError(
            f"{path}: not a ring of frames; give the file that the recorder writes frames to"
        )
    _, version, rows, columns, slots = HEAD.unpack(head)
    wanted = HEAD_BYTES + slots * (NUMBER.size + BODY.size + 4 * rows * columns)
    sound = 0 < rows <= LARGEST_SIDE and 0 < columns <= LARGEST_SIDE and slots > 1
    if version != VERSION or not sound or size < wanted:
        raise InputDataError(
            f"{path}: a damaged ring of frames, or one of another version; let it be made anew"
        )
    return rows, columns, slots
