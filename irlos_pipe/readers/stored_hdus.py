"""How a FITS file is built, from its bytes: checked before astropy reads it, which believes every size."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.text import printable
from irlos_pipe.files.processes import require_memory
from irlos_pipe.files.regular import fits

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


@dataclass(frozen=True)
class StoredHdu:
    """An HDU as it is stored."""

    label: str  # ``path: HDU index (NAME)``
    place: int  # where its header begins in the file
    header: bytes  # whole blocks
    size: int  # bytes of data, without the padding of the last block
    datasum: int | None  # what the header states as the sum of the data

    @property
    def begin(self) -> int:
        """Where its data begin in the file."""
        return self.place + len(self.header)

    @property
    def behind(self) -> int:
        """Where the next HDU begins."""
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
    _require_unpackable(image, size, label)
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


def _require_unpackable(size: int, stored: int, label: str) -> None:
    """Refuse a tile-compressed image that announces more than it can hold, or than is unpacked unseen."""
    if size > MAX_COMPRESSION * stored:
        raise InputDataError(
            f"{label}: the header announces {size} bytes of data, more than {stored} compressed bytes can "
            "hold: truncated, or a wrong header"
        )
    if size > MAX_TILED_BYTES:
        raise InputDataError(
            f"{label}: {size} bytes when unpacked, more than {MAX_TILED_BYTES} are not unpacked in "
            "memory; unpack the file"
        )


def _sum(stream: BinaryIO, hdu: StoredHdu) -> int:
    """Sum of the data in ones' complement, of whose two zeros this is the one."""
    stream.seek(hdu.begin)
    total, left = 0, hdu.behind - hdu.begin
    while left and (piece := stream.read(min(PIECE_BYTES, left))):
        left -= len(piece)
        words = np.frombuffer(piece + bytes(-len(piece) % 4), ">u4")
        total += int(words.sum(dtype=np.uint64))
    return total % (2**32 - 1)
