"""Tables that are handed on, as FITS and as CSV, with the same header."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.conventions.text import printable
from irlos_pipe.files.fits import fits
from irlos_pipe.product.fits_file import ascii_text, fits_content
from irlos_pipe.product.header import Card, Origin, header_cards


@dataclass(frozen=True)
class Column:
    """A column of numbers.

    Attributes
    ----------
    name : str
        Its name in CSV, with the unit, for example ``offset_nm``; FITS has it in capitals without.
    pattern : str
        Format of a number in CSV.
    """

    name: str
    unit: str
    values: np.ndarray
    description: str = ""
    pattern: str = ""


@dataclass(frozen=True)
class Table:
    """A table for other programs.

    Attributes
    ----------
    name : str
        Of the table, for FITS.
    category : str
        Category of the product.
    note : str
        The convention that nobody may miss; the first line of a CSV file.
    facts : sequence of Card
        Further cards of the header.
    """

    name: str
    category: str
    columns: Sequence[Column]
    note: str = ""
    facts: Sequence[Card] = ()


def table_content(table: Table, suffix: str, origin: Origin) -> bytes:
    """Return the file of a `table`.

    Parameters
    ----------
    table : Table
        What is handed on.
    suffix : str
        ``.fits`` or ``.csv``.
    origin : Origin
        Where its numbers come from.
    """
    cards = header_cards(replace(origin, category=table.category), table.facts)
    return _fits(table, cards) if suffix == ".fits" else _csv(table, cards)


def comment_block(cards: Sequence[Card], note: str = "") -> str:
    """Return the header of a CSV file: ``# KEYWORD = value / comment`` in every line, a `note` first."""
    lines = [note] if note else []
    for card in cards:
        lines.append(f"{card.key} = {card.value}" + (f" / {card.comment}" if card.comment else ""))
    return "".join(f"# {printable(line)}\n" for line in lines)


def _csv(table: Table, cards: Sequence[Card]) -> bytes:
    text = io.StringIO()
    text.write(comment_block(cards, table.note))
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.name for column in table.columns])
    written = [
        [format(value, column.pattern) for value in column.values.tolist()] for column in table.columns
    ]
    writer.writerows(zip(*written, strict=True))
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
