"""A ring of frames in shared memory, between the program that reads the detector and the loop.

It is a file, in /dev/shm or elsewhere, that both sides map. Either side may be killed and started again:
the writer goes on where the file stands, and a reader sees whatever has not been overwritten. A slot is
checked by its number and a checksum, so that a half-written frame is never taken for a whole one.

Layout, little-endian: a head of 64 bytes (magic ``IRLOSRNG``, version, rows, columns, slots as uint32; number
of frames written so far as uint64 at byte 24), then the slots: number of the frame from 1 (uint64), counter
(int64), time (float64), CRC-32 of counter, time and pixels (uint32), 4 bytes of padding, pixels (float32, x
fastest), photo-electrons without dark and background.
"""

import mmap
import os
import struct
import time
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from irlos_pipe.control.exposures import Read
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.focus.source import Arrival, Fault, Notice

MAGIC, VERSION = b"IRLOSRNG", 1
HEAD = struct.Struct("<8s4I")
HEAD_BYTES, WRITTEN_AT = 64, 24
NUMBER = struct.Struct("<Q")
BODY = struct.Struct("<qdI4x")
POLL_S = 0.0005  # between looks for a frame
LOOK_S = 0.25  # between looks whether the file is still the one that is open
LARGEST_SIDE = 4096


class _Shape(NamedTuple):
    """Of a ring: what its head states."""

    rows: int
    columns: int
    slots: int

    @property
    def stride(self) -> int:
        return NUMBER.size + BODY.size + 4 * self.rows * self.columns

    @property
    def size(self) -> int:
        return HEAD_BYTES + self.slots * self.stride

    def at(self, number: int) -> int:
        """Where the slot of the frame of a `number` begins."""
        return HEAD_BYTES + (number - 1) % self.slots * self.stride


class RingWriter:
    """Writes frames of a `window` of rows and columns; so many `slots` of them are kept.

    An existing ring of the same shape is continued, any other file there is refused.

    Raises `InputDataError` if the file is no ring of this shape; `OSError` if it cannot be made.
    """

    def __init__(self, path: Path, window: tuple[int, int], slots: int = 64):
        self._shape = _Shape(*window, slots)
        if not path.exists():
            temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
            try:
                with open(temporary, "wb") as stream:
                    stream.write(HEAD.pack(MAGIC, VERSION, *self._shape))
                    stream.flush()
                    os.posix_fallocate(stream.fileno(), 0, self._shape.size)
                os.replace(temporary, path)
            finally:
                temporary.unlink(missing_ok=True)
        rows, columns, kept = found = _shape_of(path)
        if found != self._shape:
            raise InputDataError(
                f"{path}: a ring of {kept} frames of {rows}x{columns} px, not of {slots} of "
                f"{window[0]}x{window[1]}; remove it or choose another file"
            )
        descriptor = os.open(path, os.O_RDWR)
        self._map = mmap.mmap(descriptor, self._shape.size)
        os.close(descriptor)

    @property
    def written(self) -> int:
        """Frames written so far."""
        return int(NUMBER.unpack_from(self._map, WRITTEN_AT)[0])

    def close(self) -> None:
        self._map.close()

    def write(self, read: Read, *, damaged: bool = False) -> None:
        """Write one frame, `read`, over the oldest; a `damaged` one, for trials, has a wrong checksum."""
        number = self.written + 1
        at = self._shape.at(number)
        pixels = np.ascontiguousarray(read.image_e, "<f4").tobytes()
        NUMBER.pack_into(self._map, at, 0)
        crc = _crc(read.counter, read.unix_s, pixels) ^ damaged
        BODY.pack_into(self._map, at + NUMBER.size, read.counter, read.unix_s, crc)
        self._map[at + NUMBER.size + BODY.size : at + self._shape.stride] = pixels
        NUMBER.pack_into(self._map, at, number)
        NUMBER.pack_into(self._map, WRITTEN_AT, number)


class RingSource:
    """Reads frames; begins with the oldest that is still there.

    It reads the file and does not map it: a file that is cut short under a map kills the process. A ring that
    is taken away, cut short or made again is reported, waited for, and read again from its oldest frame.

    Raises `InputDataError` if the file is no ring.
    """

    def __init__(self, path: Path):
        self.path, self._lost = path, ""
        self._take(*_opened(path))

    def poll(self, timeout_s: float) -> Sequence[Arrival]:
        until = time.monotonic() + timeout_s
        while True:
            if self._looked_s + LOOK_S < time.monotonic() and (news := self._look()):
                return news
            if self._written() >= self._next:
                return self._frames()
            if time.monotonic() >= until:
                return []
            time.sleep(POLL_S)

    def close(self) -> None:
        os.close(self._descriptor)

    def _take(self, descriptor: int, shape: _Shape) -> None:
        self._descriptor, self._shape, self.window = descriptor, shape, (shape.rows, shape.columns)
        self._looked_s = time.monotonic()
        self._next = max(1, self._oldest(self._written()))

    def _oldest(self, written: int) -> int:
        """The oldest frame that is still there; the slot of the one before may be written to."""
        return written - self._shape.slots + 2

    def _written(self) -> int:
        """Frames written so far, 0 where the head is gone; read until it is the same twice."""
        content = self._read(NUMBER.size, WRITTEN_AT)
        while content != (again := self._read(NUMBER.size, WRITTEN_AT)):
            content = again
        return int(NUMBER.unpack(content)[0]) if len(content) == NUMBER.size else 0

    def _read(self, size: int, at: int) -> bytes:
        try:
            return os.pread(self._descriptor, size, at)
        except OSError:  # of a disk that is away
            return b""

    def _frames(self) -> list[Arrival]:
        """What has been written since the last poll."""
        written, found = self._written(), list[Arrival]()
        lost = self._oldest(written) - self._next
        if lost > 0:
            found.append(Fault(f"{self.path}: {lost} frames overwritten before they were read"))
            self._next += lost
        while self._next <= written:
            found.append(self._frame(self._next))
            self._next += 1
        return found

    def _frame(self, number: int) -> Read | Fault:
        slot = self._read(self._shape.stride, self._shape.at(number))
        if len(slot) < self._shape.stride:
            return Fault(f"{self.path}: frame {number} is not there: the file was cut short")
        counter, unix_s, crc = BODY.unpack_from(slot, NUMBER.size)
        pixels = slot[NUMBER.size + BODY.size :]
        if NUMBER.unpack_from(slot)[0] != number or crc != _crc(counter, unix_s, pixels):
            return Fault(f"{self.path}: frame {number} is damaged")
        return Read(counter, unix_s, np.frombuffer(pixels, "<f4").reshape(self.window))

    def _look(self) -> list[Arrival]:
        """Whether the file is still that ring; what is wrong with it is named once."""
        self._looked_s = time.monotonic()
        if self._is_the_same() and not self._lost:
            return []
        try:
            descriptor, shape = _opened(self.path)
        except InputDataError as error:
            first, self._lost = not self._lost, str(error)
            return [*self._frames(), Notice(f"{self._lost}; waiting for it")] if first else []
        self._lost = ""
        if self._is_the_same():
            os.close(descriptor)
            return [Notice(f"{self.path}: the ring is there again")]
        rest = self._frames()
        self.close()
        self._take(descriptor, shape)
        text = f"made anew, with frames of {shape.rows}x{shape.columns} px; the loop reads these now"
        return [*rest, Notice(f"{self.path}: {text}", counts_anew=True)]

    def _is_the_same(self) -> bool:
        """Whether the path leads to the file that is open, whole, and with the frames that were read."""
        try:
            named, opened = os.stat(self.path), os.fstat(self._descriptor)
        except OSError:
            return False
        same = (named.st_dev, named.st_ino) == (opened.st_dev, opened.st_ino)
        return same and opened.st_size >= self._shape.size and self._written() >= self._next - 1


def window_of(path: Path) -> tuple[int, int]:
    """Return rows and columns of the frames of the ring at `path`.

    Raises `InputDataError` if the file is no ring.
    """
    return _shape_of(path)[:2]


def _shape_of(path: Path) -> _Shape:
    descriptor, shape = _opened(path)
    os.close(descriptor)
    return shape


def _crc(counter: int, unix_s: float, pixels: bytes) -> int:
    return zlib.crc32(pixels, zlib.crc32(struct.pack("<qd", counter, unix_s)))


def _opened(path: Path) -> tuple[int, _Shape]:
    """A descriptor of a ring, and its shape."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # of a pipe, too, without waiting
        try:
            head = os.pread(descriptor, HEAD.size, 0)
            if len(head) < HEAD.size or not head.startswith(MAGIC):
                raise InputDataError(
                    f"{path}: not a ring of frames; give the file that the recorder writes frames to"
                )
            _, version, *numbers = HEAD.unpack(head)
            shape = _Shape(*numbers)
            sound = 0 < shape.rows <= LARGEST_SIDE and 0 < shape.columns <= LARGEST_SIDE and shape.slots > 1
            if version != VERSION or not sound or os.fstat(descriptor).st_size < shape.size:
                raise InputDataError(
                    f"{path}: a damaged ring of frames, or one of another version; let it be made anew"
                )
            return descriptor, shape
        except BaseException:
            os.close(descriptor)
            raise
    except OSError as error:
        raise InputDataError(f"{path}: cannot be read as a ring of frames: {error.strerror}") from error
