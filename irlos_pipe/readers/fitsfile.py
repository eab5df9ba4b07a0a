"""Open FITS files; whatever is wrong with one is reported in a line that names file and HDU."""

from __future__ import annotations

import gzip
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import InputDataError, IrlosError
from irlos_pipe.files.late import fits
from irlos_pipe.files.memory import require_memory
from irlos_pipe.files.regular import open_regular

FITS_SUFFIXES = (".fits", ".fit", ".fts", ".fits.gz", ".fits.fz")
FITS_BEGIN, GZIP_BEGIN = b"SIMPLE", b"\x1f\x8b"
MAX_REST_BYTES = 2**20  # looked at behind the last HDU
CARD_BYTES = 80
PIECE_BYTES = 2880 * 364  # whole blocks, about a megabyte
# What astropy would count up to, or step back over for ever.
COUNTS = re.compile(rb"(Z?NAXIS {2,3}|TFIELDS )= *([0-9]{4,})")
NEGATIVE = re.compile(rb"(Z?NAXIS[0-9 ]{2,3}|TFIELDS |[PG]COUNT  )= *(-[0-9]+)")
MIN_WINDOW_PX = 5
MAX_WINDOW_PX = 4096
MAX_UNPACKED_BYTES = 2**29  # of an HDU in a compressed file: 30 000 frames of 64x64 px
MAX_COMPRESSION = 1100  # deflate makes no more of less


def has_fits_name(path: Path) -> bool:
    """Return whether a file is named like a FITS file."""
    return path.name.lower().endswith(FITS_SUFFIXES)


def stem(path: Path) -> str:
    """Return the name of a FITS file without its suffix; other dots belong to the name."""
    suffix = next(
        (end for end in sorted(FITS_SUFFIXES, key=len, reverse=True) if path.name.lower().endswith(end)), ""
    )
    return path.name[: len(path.name) - len(suffix)]


@contextmanager
def open_fits(path: Path, *, verify: bool = True) -> Iterator[fits.HDUList]:
    """Open a FITS file whose HDUs all fit into it.

    Parameters
    ----------
    path : Path
        The file.
    verify : bool
        Compare the data with their checksums, which reads all of them.

    Raises
    ------
    InputDataError
        No access, no regular file, empty, truncated, damaged by its own checksum, changed while the
        block lasts, or not FITS; also for any error of astropy inside the block.
    """
    try:
        before = _stamp(path)
        _require_content(path)
        _require_countable(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # opened here, for astropy leaves its own stream open when a header is damaged
            # and one HDU after the other, so that a size is checked before what follows is sought
            with open_regular(path) as stream, fits.open(stream, memmap=False, lazy_load_hdus=True) as hdus:
                _require_complete(hdus, path)
                _require_end(hdus, path)
                if verify:
                    _require_sums(hdus, path)
                yield hdus
        _require_unchanged(path, before)
    except IrlosError:
        raise
    except PermissionError:
        raise InputDataError(f"{path}: no permission to read it") from None
    except Exception as error:  # a damaged file can raise nearly anything from inside astropy
        if not path.is_file():
            raise InputDataError(f"{path}: {_no_file(path)}") from None
        _require_unchanged(path, before)
        raise InputDataError(
            f"{path}: cannot be read as FITS, damaged or cut off: {_one_line(error)}"
        ) from None


def has_image(hdu: fits.hdu.base._BaseHDU) -> bool:
    """Return whether an HDU holds an image with pixels."""
    return hdu.is_image and hdu.header.get("NAXIS", 0) > 0


def first_image(path: Path, hdus: fits.HDUList) -> tuple[int, fits.hdu.base._BaseHDU]:
    """Return number and HDU of the first image among the `hdus` of the file `path`.

    Raises
    ------
    InputDataError
        No image in the file.
    """
    found = next(((index, hdu) for index, hdu in enumerate(hdus) if has_image(hdu)), None)
    if found is None:
        raise InputDataError(f"{path}: no image in the file")
    return found


def require_one(path: Path, found: Sequence[object], what: str) -> None:
    """Raise InputDataError if several HDUs were `found` where one is read; `what` names them."""
    if len(found) > 1:
        raise InputDataError(f"{path}: {len(found)} {what}, of which one can be read; give each its own file")


def image_array(hdu: fits.hdu.base._BaseHDU, where: str) -> np.ndarray:
    """Return the image of `hdu` as an array (frames, rows, columns) of native byte order.

    Raises
    ------
    InputDataError
        Wrong number of axes, no frames, or a window of absurd size; `where` begins the message.
    """
    shape = tuple(hdu.header.get(f"NAXIS{axis}", 0) for axis in range(hdu.header.get("NAXIS", 0), 0, -1))
    if len(shape) not in (2, 3):
        raise InputDataError(f"{where}: axes {shape or 'none'}, expected (frames, y, x) or (y, x)")
    if 0 in shape:
        raise InputDataError(f"{where}: axes {shape}: no pixels in it")
    data = native(hdu.data)
    return require_cube(data if data.ndim == 3 else data[None], where)


def require_cube(data: np.ndarray, where: str) -> np.ndarray:
    """Return `data` (frames, rows, columns) if it can be a cube of images.

    Raises
    ------
    InputDataError
        Not numbers, no frames, or a window of absurd size; `where` begins the message.
    """
    if data.dtype.kind not in "iuf":
        raise InputDataError(f"{where}: pixels of type {data.dtype}, expected real numbers")
    if data.shape[0] == 0:
        raise InputDataError(f"{where}: no frames")
    if min(data.shape[1:]) < MIN_WINDOW_PX or max(data.shape[1:]) > MAX_WINDOW_PX:
        raise InputDataError(
            f"{where}: axes {data.shape} read as (frames, y, x) give a window of "
            f"{data.shape[1]}x{data.shape[2]} px, expected "
            f"{MIN_WINDOW_PX} to {MAX_WINDOW_PX} px a side"
        )
    return data


def native(data: np.ndarray) -> np.ndarray:
    """Return an array in the byte order of this machine, which torch and numba insist on."""
    return np.ascontiguousarray(data.astype(data.dtype.newbyteorder("="), copy=False))


def hdu_label(path: Path, index: int, hdu: fits.hdu.base._BaseHDU) -> str:
    """Return ``path: HDU index (NAME)`` for an `hdu`, from its `path` and `index`."""
    return f"{path}: HDU {index}" + (f" ({hdu.name})" if hdu.name else "")


def header_number(header: fits.Header, key: str) -> float | None:
    """Return the finite number that the `header` has under `key`, or None."""
    value: Any = header.get(key)
    usable = isinstance(value, (int, float)) and not isinstance(value, bool) and np.isfinite(value)
    return float(value) if usable else None


def _stamp(path: Path) -> tuple[int, int, int]:
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns


def _require_unchanged(path: Path, before: tuple[int, int, int]) -> None:
    if not path.is_file() or _stamp(path) != before:
        raise InputDataError(f"{path}: changed while it was read; run again when it is complete")


def _no_file(path: Path) -> str:
    if path.is_symlink() and not path.exists():
        return f"a link to {path.readlink()}, which is not there"
    return "not a regular file" if path.exists() else "no such file"


def _require_content(path: Path) -> None:
    with open_regular(path) as stream:
        begin = stream.read(len(FITS_BEGIN))
    if not begin:
        raise InputDataError(f"{path}: the file is empty (0 bytes)")
    if begin != FITS_BEGIN and not begin.startswith(GZIP_BEGIN):
        raise InputDataError(f"{path}: not a FITS file, for it does not begin with '{FITS_BEGIN.decode()}'")


def _require_countable(path: Path) -> None:
    """Refuse headers with more axes or columns than FITS allows, or with sizes below zero."""
    for piece in _pieces(path):
        # Looking at the beginnings of cards only is a hundred times faster than a search through all bytes.
        first_letters = np.frombuffer(piece, np.uint8)[::CARD_BYTES]
        for card in np.flatnonzero(np.isin(first_letters, list(b"NTZPG"))):
            place = int(card) * CARD_BYTES
            for pattern, allowed in ((COUNTS, "999"), (NEGATIVE, "nothing below 0")):
                if found := pattern.match(piece, place):
                    key, number = (group.decode().strip() for group in found.groups())
                    raise InputDataError(
                        f"{path}: {key} = {number} in a header, FITS allows {allowed}: damaged"
                    )


def _pieces(path: Path) -> Iterator[bytes]:
    """Yield all of a plain file, piece by piece; of a compressed one what holds its first headers."""
    with open_regular(path) as stream:
        packed = stream.read(len(GZIP_BEGIN)) == GZIP_BEGIN
        stream.seek(0)
        if packed:
            yield gzip.GzipFile(fileobj=stream).read(MAX_REST_BYTES)
        else:
            yield from iter(partial(stream.read, PIECE_BYTES), b"")


def _require_complete(hdus: fits.HDUList, path: Path) -> None:
    """Compare the sizes the headers announce with the file, before anything is allocated."""
    file_bytes, previous = path.stat().st_size, -1
    for index, hdu in enumerate(hdus):
        info = hdu.fileinfo()
        if info is None:
            continue
        if hdu.size < 0 or info["datLoc"] <= previous:  # astropy would go back and read it for ever
            raise InputDataError(f"{hdu_label(path, index, hdu)}: the header announces a size below zero")
        previous = info["datLoc"]
        stored = info["datSpan"] if _is_plain(path) else file_bytes
        if _is_plain(path) and info["datLoc"] + min(hdu.size, stored) > file_bytes:
            raise InputDataError(
                f"{hdu_label(path, index, hdu)}: the header announces {hdu.size} bytes of data, the "
                f"file holds {max(0, file_bytes - info['datLoc'])}: truncated, or a wrong header"
            )
        if hdu.size > stored:
            _require_unpackable(hdu.size, stored, hdu_label(path, index, hdu))
        require_memory(2.0 * hdu.size, hdu_label(path, index, hdu), InputDataError, "cut it into parts")


def _require_unpackable(size: int, stored: int, where: str) -> None:
    """Refuse compressed data that announce more than they can hold, or than should be unpacked unseen."""
    if size > MAX_COMPRESSION * stored:
        raise InputDataError(
            f"{where}: the header announces {size} bytes of data, more than {stored} compressed bytes can "
            "hold: truncated, or a wrong header"
        )
    if size > MAX_UNPACKED_BYTES:
        raise InputDataError(
            f"{where}: {size} bytes when unpacked, more than {MAX_UNPACKED_BYTES} are not unpacked in "
            "memory; unpack the file"
        )


def _require_end(hdus: fits.HDUList, path: Path) -> None:
    """Astropy passes in silence over an extension whose header is damaged, and all that follows it."""
    last = hdus[-1].fileinfo()
    if not _is_plain(path) or last is None:
        return
    with open_regular(path) as stream:
        stream.seek(last["datLoc"] + last["datSpan"])
        if stream.read(MAX_REST_BYTES).strip(b"\0 "):
            raise InputDataError(
                f"{path}: HDU {len(hdus)}: its header is cut off or damaged: something follows HDU "
                f"{len(hdus) - 1} that is no extension"
            )


def _require_sums(hdus: fits.HDUList, path: Path) -> None:
    """Compare the data with their checksum where the file gives one."""
    for index, hdu in enumerate(hdus):
        if "DATASUM" in hdu.header and not hdu.verify_datasum():
            raise InputDataError(
                f"{hdu_label(path, index, hdu)}: the data do not fit their DATASUM: damaged, or changed "
                "without a new one"
            )


def _is_plain(path: Path) -> bool:
    """Return whether positions in the file are those of its headers and data."""
    return not path.name.lower().endswith((".gz", ".fz"))


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
