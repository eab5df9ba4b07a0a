"""Open FITS files; whatever is wrong with one is reported in a line that names file and HDU."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from irlos_pipe.conventions.errors import InputDataError, IrlosError
from irlos_pipe.files.regular import fits, open_unpacked, what_else
from irlos_pipe.readers.stored_hdus import CARD_BYTES, require_sums, stored_hdus, unreadable_cards

# Packers, archives and browsers add to a name: cube.fits.fz, cube.fits.bz2, cube.fits (1), cube.fits.1
FITS_NAME = re.compile(
    r"(?P<stem>.*)\.(fits?|fts)(\.(fz|gz|bz2|xz|z|zip))*( ?\(\d+\)|\.\d+)?", re.IGNORECASE | re.DOTALL
)
FITS_BEGIN = b"SIMPLE"
MIN_WINDOW_PX = 5
MAX_WINDOW_PX = 4096
SHOWN_CARDS = 3


def has_fits_name(path: Path) -> bool:
    """Return whether a file is named like a FITS file, packed or not."""
    return FITS_NAME.fullmatch(path.name) is not None


def stem(path: Path) -> str:
    """Return the name of a FITS file without its suffixes; other dots belong to the name."""
    found = FITS_NAME.fullmatch(path.name)
    return found["stem"] if found else path.name


@contextmanager
def open_fits(path: Path, *, verify: bool = True, notes: list[str] | None = None) -> Iterator[fits.HDUList]:
    """Open a FITS file whose HDUs all fit into it.

    With `verify` the data are compared with their checksums, which reads all of them. `notes` gets a line
    that names the cards that cannot be read; they are left out.

    Raises `InputDataError` for a file that may not be read, is no regular one, empty, truncated, damaged by
    its own checksum, changed while the block lasts, or not FITS; also for any error of astropy inside it.
    """
    try:
        before = _stamp(path)
        with warnings.catch_warnings(), open_unpacked(path) as stream:
            warnings.simplefilter("ignore")
            _require_fits(stream, path)
            stored = stored_hdus(stream, path)
            if verify:
                require_sums(stream, stored)
            if unreadable := unreadable_cards(stored):
                stream = _without(stream, unreadable)
                if notes is not None:
                    notes.append(_note(path, list(unreadable.values())))
            stream.seek(0)
            # what follows the last HDU is not for astropy, nor are more of them than there are
            with fits.open(stream, memmap=False, lazy_load_hdus=True) as opened:
                yield fits.HDUList([opened[index] for index in range(len(stored))])
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


def file_header(hdus: fits.HDUList) -> fits.Header:
    """Return the header of HDU 0, and where that has no image what only HDU 1 says.

    There fpack leaves the header of an image that it packs.
    """
    header = hdus[0].header
    if len(hdus) > 1 and not has_image(hdus[0]):
        header = header.copy()
        header.extend(hdus[1].header, unique=True)
    return header


def first_image(path: Path, hdus: fits.HDUList) -> tuple[int, fits.hdu.base._BaseHDU]:
    """Return number and HDU of the first image among the `hdus` of the file `path`.

    Raises `InputDataError` for a file without an image.
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

    Raises `InputDataError` for a wrong number of axes, no frames, or a window of absurd size; `where` begins
    the message.
    """
    shape = image_shape(hdu)
    if len(shape) not in (2, 3):
        raise InputDataError(f"{where}: axes {shape or 'none'}, expected (frames, y, x) or (y, x)")
    if 0 in shape:
        raise InputDataError(f"{where}: axes {shape}: no pixels in it")
    data = native(hdu.data).reshape(shape)
    return require_cube(data if data.ndim == 3 else data[None], where)


def image_shape(hdu: fits.hdu.base._BaseHDU) -> tuple[int, ...]:
    """Return the axes that an image has by its header; of more than three without those of length one."""
    shape = tuple(hdu.header.get(f"NAXIS{axis}", 0) for axis in range(hdu.header.get("NAXIS", 0), 0, -1))
    return shape if len(shape) <= 3 else tuple(length for length in shape if length != 1)


def require_cube(data: np.ndarray, where: str) -> np.ndarray:
    """Return `data` (frames, rows, columns) if it can be a cube of images.

    Raises `InputDataError` for what is not numbers, has no frames, or a window of absurd size; `where` begins
    the message.
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


def _require_fits(stream: BinaryIO, path: Path) -> None:
    begin = stream.read(len(FITS_BEGIN))
    if begin != FITS_BEGIN:
        what = what_else(stream) or f"not a FITS file, for it does not begin with '{FITS_BEGIN.decode()}'"
        raise InputDataError(f"{path}: {what}")


def _without(stream: BinaryIO, cards: Mapping[int, str]) -> BinaryIO:
    """The same file with blank cards at these places."""
    stream.seek(0)
    content = io.BytesIO(stream.read())
    for place in cards:
        content.seek(place)
        content.write(b" " * CARD_BYTES)
    return content


def _note(path: Path, cards: Sequence[str]) -> str:
    more = f" and {len(cards) - SHOWN_CARDS} more" if len(cards) > SHOWN_CARDS else ""
    shown = ", ".join(f"'{card}'" for card in cards[:SHOWN_CARDS])
    return f"{path}: cards that cannot be read are left out: {shown}{more}"


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
