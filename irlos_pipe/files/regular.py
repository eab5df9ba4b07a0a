"""Open regular files only: a pipe would block for ever, a device may never end.

Files come as they were before somebody packed them; their content says how, whatever their name.
"""

from __future__ import annotations

import bz2
import errno
import gzip
import io
import lzma
import os
import re
import stat
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.late import LateModule
from irlos_pipe.files.processes import require_memory

HEAD_BYTES = 512  # by which a file is recognised
PIECE_BYTES = 2**20  # unpacked at a time
MAX_LAYERS = 2  # of packing: a browser may pack what is packed already
MAX_UNPACKED_BYTES = 2**29  # 60 000 frames of 64x64 px in 16 bit
USUAL_COMPRESSION = 8  # times its size that a file may unpack to at least; real images stay far below

Opener = Callable[[BinaryIO], io.BufferedIOBase]
PACKED: dict[bytes, Opener] = {
    b"\x1f\x8b": lambda stream: gzip.GzipFile(fileobj=stream),
    b"BZh": bz2.BZ2File,
    b"\xfd7zXZ\0": lzma.LZMAFile,
}
# What lies under the name of a data file when something went wrong on its way, by how it begins.
TAKEN_FOR_DATA = {
    rb"$": "the file is empty (0 bytes)",
    rb"\x1f\x9d": "packed by compress (.Z), which is not read; unpack it with gzip -d",
    rb"PK\x03\x04": "a zip archive, which is not read; unpack it",
    rb"(?i)(\xef\xbb\xbf)?\s*<(!doctype html|html)": "a web page (HTML), not the file itself; "
    "download it again, logged in where the archive asks for it",
    rb"(?i)(\xef\xbb\xbf)?\s*<": "XML or HTML, not the file itself; download it again",
    rb"version https://git-lfs": "a pointer of Git LFS, not the file itself; fetch it with git lfs pull",
    rb"(\.\./)*(\.git)?/annex/objects/": "a pointer of git-annex, not the file itself; "
    "fetch it with git annex get",
    rb"\x89HDF": "an HDF5 file, not a FITS file",
    rb"(\xef\xbb\xbf|\xff\xfe|\xfe\xff)": "begins with a byte order mark: saved as text, which damages it; "
    "get it again",
}


def open_regular(path: str | Path) -> io.BufferedReader:
    """Open the file at `path` for reading; links are followed.

    Raises `OSError` when it cannot be opened, or is a folder, pipe, socket or device.
    """
    return open(path, "rb", opener=_opened)


def read_regular(path: str | Path) -> str:
    """Return the text, in UTF-8, of the file at `path`.

    Raises `OSError` as `open_regular`, and `UnicodeDecodeError` when it is not UTF-8.
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


@contextmanager
def open_unpacked(path: Path) -> Iterator[BinaryIO]:
    """Open the file at `path` for reading, unpacked if its content is that of gzip, bzip2 or xz.

    Raises `InputDataError` where the packed content is cut off or damaged, or unpacks to more than is read in
    memory, and `OSError` as `open_regular`.
    """
    with open_regular(path) as file:
        stream: BinaryIO = file
        for _ in range(MAX_LAYERS):
            begin = _begin(stream)
            opener = next((one for magic, one in PACKED.items() if begin.startswith(magic)), None)
            if opener is None:
                break
            stream = _unpacked(opener, stream, path)
        yield stream


def what_else(stream: BinaryIO) -> str:
    """Return what a `stream` holds that is no data file, and what to do; "" if it is not known."""
    begin = _begin(stream)
    return next((what for how, what in TAKEN_FOR_DATA.items() if re.match(how, begin)), "")


def _begin(stream: BinaryIO) -> bytes:
    stream.seek(0)
    begin = stream.read(HEAD_BYTES)
    stream.seek(0)
    return begin


def _unpacked(opener: Opener, stream: BinaryIO, path: Path) -> BinaryIO:
    """All of a packed stream; counted while it is unpacked, for few bytes can become many."""
    packed_bytes = stream.seek(0, io.SEEK_END)
    stream.seek(0)
    most = max(MAX_UNPACKED_BYTES, USUAL_COMPRESSION * packed_bytes)
    content = io.BytesIO()
    try:
        with opener(stream) as source:
            while piece := source.read(PIECE_BYTES):
                content.write(piece)
                if content.tell() > most:
                    raise InputDataError(
                        f"{path}: {packed_bytes} bytes that unpack to more than {most}, which are not "
                        "unpacked in memory; unpack the file"
                    )
                if content.tell() % (64 * PIECE_BYTES) == 0:
                    require_memory(content.tell(), str(path), InputDataError, "unpack the file")
    except (EOFError, OSError, ValueError, lzma.LZMAError, zlib.error) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise InputDataError(f"{path}: packed, and cut off or damaged: {error}") from None
    content.seek(0)
    return content


if TYPE_CHECKING:
    from astropy.io import fits as fits
else:
    fits = LateModule("astropy.io.fits")


def first_image(path: Path) -> tuple[np.ndarray, Mapping[str, Any]]:
    """Return the first image of the FITS file at `path` that has data, in float64, and its header.

    Raises `ValueError` where the file cannot be read, or holds no image; names the reason and not the file.
    """
    try:
        with open_regular(path) as stream, fits.open(stream, memmap=False) as hdus:
            image = next((hdu for hdu in hdus if hdu.is_image and hdu.data is not None), None)
            if image is not None:
                return np.asarray(image.data, dtype=np.float64), image.header
    except (OSError, TypeError, ValueError) as error:
        raise ValueError(f"cannot be read: {str(error).splitlines()[0]}") from None
    raise ValueError("holds no image")
