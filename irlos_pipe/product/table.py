"""Tables that are handed on, as FITS and as CSV, with the same header."""

from __future__ import annotations

import csv
import io
import textwrap
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.conventions.text import printable
from irlos_pipe.files.fits import fits
from irlos_pipe.product.header import Card, Origin, Value, header_cards


@dataclass(frozen=True)
class Column:
    """A column of numbers."""

    name: str  # in CSV, with the unit, for example ``offset_nm``; FITS has it in capitals without
    unit: str
    values: np.ndarray
    description: str = ""
    pattern: str = ""  # format of a number in CSV


@dataclass(frozen=True)
class Table:
    """A table for other programs."""

    name: str  # for FITS
    category: str  # of the product
    columns: Sequence[Column]
    note: str = ""  # the convention that nobody may miss; the first line of a CSV file
    facts: Sequence[Card] = ()  # further cards of the header


def table_content(table: Table, suffix: str, origin: Origin) -> bytes:
    """Return the file of a `table`, ``.fits`` or ``.csv`` by its `suffix`; its numbers come from `origin`.

    Where a check failed, the first line says so.
    """
    if failed := [check.name for check in origin.checks if not check.passed]:
        table = replace(table, note=f"QC FAILED, DO NOT APPLY ({', '.join(failed)}). {table.note}")
    cards = header_cards(replace(origin, category=table.category), table.facts)
    if suffix == ".fits":
        return _fits(table, cards)
    written = ([format(value, one.pattern) for value in one.values.tolist()] for one in table.columns)
    return csv_content(cards, [one.name for one in table.columns], written, table.note)


def csv_content(
    cards: Sequence[Card], names: Iterable[str], columns: Iterable[list], note: str = ""
) -> bytes:
    """Return a CSV file with the `names` of its `columns`.

    Its header says ``# KEYWORD = value / comment`` in every line for each of the `cards`, a `note` first.
    """
    lines = [note] if note else []
    for card in cards:
        lines.append(f"{card.key} = {card.value}" + (f" / {card.comment}" if card.comment else ""))
    text = io.StringIO()
    text.write("".join(f"# {printable(line)}\n" for line in lines))
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows(zip(*columns, strict=True))
    return text.getvalue().encode()


def _fits(table: Table, cards: Sequence[Card]) -> bytes:
    columns = [
        fits.Column(
            _plain_name(column), "J" if column.values.dtype.kind == "i" else "D",
            unit=column.unit or None, array=column.values,
        )
        for column in table.columns
    ]  # fmt: skip
    hdu = fits.BinTableHDU.from_columns(columns, name=table.name)
    for number, column in enumerate(table.columns, 1):
        if column.description:
            hdu.header[f"TCOMM{number}"] = ascii_text(column.description)
    if table.note:
        hdu.header["COMMENT"] = ascii_text(table.note)
    return fits_content([hdu], cards)


def _plain_name(column: Column) -> str:
    return column.name.removesuffix(f"_{column.unit}").upper()


# -- FITS files with full headers and checksums --------------------------------------------------------

CARD_LETTERS = 80  # of a card, by the standard of FITS
MAX_CARDS = 9  # over which one text may be spread
# Letters of units and comments that FITS, which is ASCII, does not have.
SPELT = str.maketrans(
    {"χ": "chi", "ν": "nu", "σ": "sigma", "λ": "lambda", "Σ": "sum", "²": "2", "±": "+-", "→": "->", "–": "-",
     "−": "-", "µ": "u", "×": "x", "″": " arcsec", "≤": "<=", "≥": ">="}
)  # fmt: skip


def fits_content(hdus: Sequence[fits.hdu.base.ExtensionHDU], cards: Iterable[Card]) -> bytes:
    """Return a FITS file: a primary header of `cards`, and the `hdus` behind it.

    Words that do not fit into a hierarchical card go on in cards of the same keyword with a number; one
    word, as a path, loses its beginning.
    """
    primary = fits.PrimaryHDU()
    for card in cards:
        for one in _in_words(card):
            _set_card(primary.header, one)
    stream = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fits.verify.VerifyWarning)
        fits.HDUList([primary, *hdus]).writeto(stream, checksum=True, output_verify="exception")
    return stream.getvalue()


def ascii_text(text: str) -> str:
    """Return a `text` in the letters that FITS has."""
    plain = text.translate(SPELT).encode("ascii", "replace").decode()
    return "".join(letter if letter.isprintable() else "?" for letter in plain)


def _set_card(header: fits.Header, card: Card) -> None:
    """Add a `card` to a `header`."""
    plain = _is_plain(card)
    keyword = card.key if plain else f"HIERARCH {card.key}"
    room = _room(card)
    value = _fitting(card.value, room)
    left = room - len(_written(value)) - 3
    header[keyword] = (value, ascii_text(card.comment)[: max(left, 0)])


def _is_plain(card: Card) -> bool:
    return len(card.key) <= 8 and " " not in card.key


def _room(card: Card) -> int:
    """Letters that a card has for its value."""
    return CARD_LETTERS - (10 if _is_plain(card) else len(f"HIERARCH {card.key} = "))


def _in_words(card: Card) -> list[Card]:
    """The cards that a `card` becomes; the words of a long text are shared out."""
    if not isinstance(card.value, str) or _is_plain(card):
        return [card]
    text = ascii_text(card.value)
    room = _room(card) - len("'' 2") - text.count("'")  # quotes are doubled
    if len(_written(text)) <= _room(card) or " " not in text or room < 1:
        return [card]
    keys = [card.key, *(f"{card.key} {number}" for number in range(2, MAX_CARDS + 1))]
    lines = textwrap.wrap(text, room)
    return [replace(card, key=key, value=line) for key, line in zip(keys, lines, strict=False)]


def _fitting(value: Value, room: int) -> Value:
    """A value that takes no more letters than there is room for, its end if it is text."""
    if not isinstance(value, str):
        return value if len(_written(value)) <= room else float(f"{value:.{max(room - 8, 1)}g}")
    text = ascii_text(value)
    while len(_written(text)) > room:
        text = text[1:]
    return text


def _written(value: Value) -> str:
    """The value as a card has it, at least as long as astropy writes it."""
    if isinstance(value, str):
        return "'" + value.replace("'", "''").ljust(8) + "'"
    return str(value) if isinstance(value, (bool, int)) else f"{value:.16G}".ljust(20)
