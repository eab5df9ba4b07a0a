"""Open FITS files; whatever is wrong with one is reported in a line that names file and HDU."""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from irlos_pipe.conventions.errors import InputDataError, IrlosError
from irlos_pipe.conventions.text import printable
from irlos_pipe.files.processes import require_memory
from irlos_pipe.files.regular import fits, open_unpacked, what_else

CARD_BYTES, BLOCK_BYTES = 80, 2880
PIECE_BYTES = BLOCK_BYTES * 364  # about a megabyte, read at once for a checksum
MAX_HDUS = 5000
MAX_HEADER_BYTES = 2**24  # of all headers of a file, 200 000 cards
MAX_REST_BYTES = 2**20  # that are examined behind the last HDU
MAX_TILED_BYTES = 2**29  # of a tile-compressed image: 30 000 frames of 64x64 px
MAX_COMPRESSION = 1100  # the largest ratio that deflate reaches
MAX_AXES = 999
BIT_PIXELS = (8, 16, 32, 64, -32, -64)
# What is asked of a header here, with its value.
ASKED = re.compile(
    rb"(SIMPLE|Z?BITPIX|Z?NAXIS\d{0,3}|[PG]COUNT|TFIELDS|GROUPS|ZIMAGE|ZTABLE|DATASUM|EXTNAME) *= *'?([^/']*)"
)
# Cards whose values every reader understands: text, truth values, numbers, none.
SOUND = re.compile(
    rb"(?:.{8}= |HIERARCH [^=]+=) *"
    rb"(?:'(?:[^']|'')*'|[TF]|[+-]?(?:\d+\.?\d*|\.\d+)(?:[ED][+-]?\d+)?|) *(?:/.*)?|CONTINUE +'.*"
)
OF_THE_DATA = re.compile(
    r"SIMPLE|XTENSION|Z?BITPIX|Z?NAXIS\d*|[PG]COUNT|GROUPS|TFIELDS|THEAP|BSCALE|BZERO|Z?BLANK|"
    r"T(FORM|TYPE|DIM|SCAL|ZERO|NULL|BCOL)\d+|Z(IMAGE|TILE\d+|CMPTYPE|NAME\d+|VAL\d+|QUANTIZ|DITHER0|SCALE|ZERO)"
)

# Packers, archives and browsers add to a name: cube.fits.fz, cube.fits.bz2, cube.fits (1), cube.fits.1
FITS_NAME = re.compile(
    r"(?P<stem>.*)\.(fits?|fts)(\.(fz|gz|bz2|xz|z|zip))*( ?\(\d+\)|\.\d+)?", re.IGNORECASE | re.DOTALL
)
FITS_BEGIN = b"SIMPLE"
MIN_WINDOW_PX = 5
MAX_WINDOW_PX = 4096
SHOWN_CARDS = 3


@dataclass(frozen=True)
class StoredHdu:
    label: str  # ``path: HDU index (NAME)``
    place: int  # where its header begins in the file
    header: bytes  # whole blocks
    size: int  # bytes of data, without the padding of the last block
    datasum: int | None  # what the header states as the sum of the data

    @property
    def begin(self) -> int:
        return self.place + len(self.header)

    @property
    def behind(self) -> int:
        return self.begin + -(-self.size // BLOCK_BYTES) * BLOCK_BYTES

    def cards(self) -> Iterator[tuple[int, bytes]]:
        """Yield place in the file and content of every card."""
        for at in range(0, len(self.header), CARD_BYTES):
            yield self.place + at, self.header[at : at + CARD_BYTES]


def stored_hdus(stream: BinaryIO, path: object) -> list[StoredHdu]:
    """Return the HDUs of a file, an open and unpacked `stream`; `path` begins the messages.

    Raises `InputDataError` for a header that is damaged, too long, or announces what the file does not hold
    or the memory does not.
    """
    file_bytes = stream.seek(0, io.SEEK_END)
    found: list[StoredHdu] = []
    header_bytes = place = 0
    while not found or place < file_bytes:
        label = f"{path}: HDU {len(found)}"
        if found and not _is_extension(stream, place, label):
            break
        if len(found) == MAX_HDUS:
            raise InputDataError(f"{path}: more than {MAX_HDUS} HDUs; give the frames as one cube")
        header = _header(stream, place, label, MAX_HEADER_BYTES - header_bytes)
        found.append(_checked(place, header, label, file_bytes))
        header_bytes, place = header_bytes + len(header), found[-1].behind
    return found


def require_sums(stream: BinaryIO, stored: Sequence[StoredHdu]) -> None:
    """Raise InputDataError where the bytes of `stored` HDUs do not add up to the sum that a header states.

    Of a tile-compressed image these are those of the table that holds it.
    """
    for hdu in stored:
        if hdu.datasum is not None and _sum(stream, hdu) != hdu.datasum % (2**32 - 1):
            raise InputDataError(
                f"{hdu.label}: the data do not fit their DATASUM: damaged, or changed without a new one"
            )


def unreadable_cards(stored: Sequence[StoredHdu]) -> dict[int, str]:
    """Return the cards of `stored` HDUs whose value no reader understands, by their place in the file.

    Raises `InputDataError` where the meaning of the data depends on one.
    """
    found = {}
    for hdu in stored:
        for place, card in hdu.cards():
            if not _has_value(card) or SOUND.fullmatch(card) or _is_understood(card):
                continue
            text = " ".join(printable(card.decode("latin-1").partition(" / ")[0]).split())
            if OF_THE_DATA.fullmatch(text.partition("=")[0].strip()):
                raise InputDataError(
                    f"{hdu.label}: the card '{text}' cannot be read, and the data depend on it"
                )
            found[place] = text.removeprefix("HIERARCH ")
    return found


def _has_value(card: bytes) -> bool:
    commentary = card.startswith((b"COMMENT ", b"HISTORY ", b"        "))
    return not commentary and (card[8:9] == b"=" or card.startswith((b"HIERARCH ", b"CONTINUE ")))


def _is_understood(card: bytes) -> bool:
    if card[8:10] != b"= " and not card.startswith(b"HIERARCH "):
        return False
    try:
        fits.Card.fromstring(card).value  # noqa: B018 (parsed when it is asked for)
    except (ValueError, fits.VerifyError):
        return False
    return True


def _is_extension(stream: BinaryIO, place: int, label: str) -> bool:
    """Whether an extension follows; False where only padding does, an error where something else does."""
    stream.seek(place)
    rest = stream.read(CARD_BYTES)
    if rest.startswith(b"XTENSION"):
        return True
    if (rest + stream.read(MAX_REST_BYTES)).strip(b"\0 "):
        before = int(label.rpartition(" ")[2]) - 1
        raise InputDataError(
            f"{label}: its header is cut off or damaged: something follows HDU {before} that is no extension"
        )
    return False


def _header(stream: BinaryIO, place: int, label: str, most_bytes: int) -> bytes:
    stream.seek(place)
    blocks = []
    while block := stream.read(BLOCK_BYTES):
        blocks.append(block)
        if any(block[at : at + 8].rstrip() == b"END" for at in range(0, len(block), CARD_BYTES)):
            header = b"".join(blocks)
            return header + b" " * (-len(header) % BLOCK_BYTES)
        if len(blocks) * BLOCK_BYTES > most_bytes:
            raise InputDataError(
                f"{label}: headers of more than {MAX_HEADER_BYTES // CARD_BYTES} cards are not read: "
                "damaged, or to be cut down"
            )
    raise InputDataError(f"{label}: its header has no END: cut off or damaged")


def _checked(place: int, header: bytes, label: str, file_bytes: int) -> StoredHdu:
    cards: dict[str, str] = {}
    for at in range(0, len(header), CARD_BYTES):
        card = header[at : at + CARD_BYTES]
        if card[:8].rstrip() == b"END":
            break
        if found := ASKED.match(card):
            cards.setdefault(found[1].decode(), found[2].decode("latin-1").strip())
    name = cards.get("EXTNAME") or ("" if place else "PRIMARY")
    label += f" ({printable(name)})" if name else ""
    _require_standard(cards, label)
    size = _size("", cards, label)
    datasum = cards.get("DATASUM", "")
    hdu = StoredHdu(label, place, header, size, int(datasum) if re.fullmatch("[0-9]+", datasum) else None)
    if hdu.begin + size > file_bytes:
        raise InputDataError(
            f"{label}: the header announces {size} bytes of data, the file holds "
            f"{max(0, file_bytes - hdu.begin)}: truncated, or a wrong header"
        )
    image = _size("Z", cards, label) if cards.get("ZIMAGE") == "T" else 0
    if image > MAX_COMPRESSION * size:
        raise InputDataError(
            f"{label}: the header announces {image} bytes of data, more than {size} compressed bytes can "
            "hold: truncated, or a wrong header"
        )
    if image > MAX_TILED_BYTES:
        raise InputDataError(
            f"{label}: {image} bytes when unpacked, more than {MAX_TILED_BYTES} are not unpacked in "
            "memory; unpack the file"
        )
    require_memory(2.0 * max(size, image), label, InputDataError, "cut it into parts")
    return hdu


def _require_standard(cards: dict[str, str], label: str) -> None:
    if cards.get("SIMPLE", "T") != "T":
        raise InputDataError(
            f"{label}: SIMPLE = {cards['SIMPLE']}: it says of itself that it is no standard FITS"
        )
    if cards.get("GROUPS") == "T" and cards.get("NAXIS1") == "0":
        raise InputDataError(f"{label}: random groups, as of radio interferometry: no image of a star")
    if cards.get("ZTABLE") == "T":
        raise InputDataError(
            f"{label}: a table packed by fpack, which is not read; unpack the file with funpack"
        )
    if (columns := _whole("TFIELDS", cards, label, 0)) > MAX_AXES:
        raise InputDataError(f"{label}: TFIELDS = {columns} in a header, FITS allows {MAX_AXES}: damaged")


def _size(prefix: str, cards: dict[str, str], label: str) -> int:
    """Bytes of the data; with the prefix Z of the image that is compressed in a table."""
    axes = _whole(f"{prefix}NAXIS", cards, label)
    if axes > MAX_AXES:
        raise InputDataError(f"{label}: {prefix}NAXIS = {axes} in a header, FITS allows {MAX_AXES}: damaged")
    bits = _whole(f"{prefix}BITPIX", cards, label, below=True)
    if bits not in BIT_PIXELS:
        raise InputDataError(
            f"{label}: {prefix}BITPIX = {bits} in a header, which FITS does not know: damaged"
        )
    values = math.prod(_whole(f"{prefix}NAXIS{axis}", cards, label) for axis in range(1, axes + 1))
    count, heap = (0, 0) if prefix else (_whole("GCOUNT", cards, label, 1), _whole("PCOUNT", cards, label, 0))
    return 0 if not axes else abs(bits) // 8 * (values if prefix else count * (heap + values))


def _whole(
    key: str, cards: dict[str, str], label: str, default: int | None = None, *, below: bool = False
) -> int:
    """The whole number under a key, not below zero unless that is allowed."""
    text = cards.get(key, "" if default is None else str(default))
    if not re.fullmatch("[+-]?[0-9]{1,19}", text):
        what = (
            f"{key} = {printable(text)} in a header is no whole number"
            if key in cards
            else f"no {key} in a header"
        )
        raise InputDataError(f"{label}: {what}, and the size of the data follows from it: damaged")
    if int(text) < 0 and not below:
        raise InputDataError(f"{label}: {key} = {text} in a header, FITS allows nothing below 0: damaged")
    return int(text)


def _sum(stream: BinaryIO, hdu: StoredHdu) -> int:
    """Sum of the data in ones' complement, of whose two zeros this is the one."""
    stream.seek(hdu.begin)
    total, left = 0, hdu.behind - hdu.begin
    while left and (piece := stream.read(min(PIECE_BYTES, left))):
        left -= len(piece)
        words = np.frombuffer(piece + bytes(-len(piece) % 4), ">u4")
        total += int(words.sum(dtype=np.uint64))
    return total % (2**32 - 1)


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
                stream.seek(0)
                content = io.BytesIO(stream.read())
                for place in unreadable:
                    content.seek(place)
                    content.write(b" " * CARD_BYTES)
                stream = content
                if notes is not None:
                    cards = list(unreadable.values())
                    more = f" and {len(cards) - SHOWN_CARDS} more" if len(cards) > SHOWN_CARDS else ""
                    shown = ", ".join(f"'{card}'" for card in cards[:SHOWN_CARDS])
                    notes.append(f"{path}: cards that cannot be read are left out: {shown}{more}")
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
        what = " ".join(str(error).split()) or type(error).__name__
        raise InputDataError(f"{path}: cannot be read as FITS, damaged or cut off: {what}") from None


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
