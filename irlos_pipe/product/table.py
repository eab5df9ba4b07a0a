"""Tables that are handed on, as FITS and as CSV, with the same header."""

from __future__ import annotations

import csv
import io
import math
import re
import textwrap
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from irlos_pipe.conventions.text import printable
from irlos_pipe.files.json import flat
from irlos_pipe.files.regular import fits
from irlos_pipe.product.product import Check
from irlos_pipe.product.results import Provenance, Recorded

Value = str | bool | int | float
FEW_WORDS = frozenset(("OF", "THE", "BY", "AS", "ABOUT", "A", "IN"))
SHA_DIGITS = 32  # of a checksum, as many as fit into a card
MAX_FILES, MAX_PARAMETERS = 400, 200  # that a header lists at most
SIDECAR_SUFFIXES = (".yaml", ".yml")

CARD_LETTERS = 80  # of a card, by the standard of FITS
MAX_CARDS = 9  # over which one text may be spread
# Letters of units and comments that FITS, which is ASCII, does not have.
SPELT = str.maketrans(
    {"χ": "chi", "ν": "nu", "σ": "sigma", "λ": "lambda", "Σ": "sum", "²": "2", "±": "+-", "→": "->", "–": "-",
     "−": "-", "µ": "u", "×": "x", "″": " arcsec", "≤": "<=", "≥": ">="}
)  # fmt: skip


@dataclass(frozen=True)
class Card:
    """One line of a header; keywords with spaces are hierarchical."""

    key: str
    value: Value
    comment: str = ""


@dataclass(frozen=True)
class Origin:
    """Where the numbers of a file come from."""

    stage: str  # that made them
    category: str  # of the product, for ``ESO PRO CATG``
    provenance: Provenance
    recordings: Sequence[Recorded] = ()  # what was observed, the most important first
    checks: Sequence[Check] = ()  # quality of the product and of what it was made from
    config: Mapping[str, Any] | None = None  # settings of the stage
    notice: str = ""  # what has to be said before any number, as of samples; empty if nothing has to


def header_cards(origin: Origin, facts: Iterable[Card] = ()) -> list[Card]:
    """Return the cards of a file, without those that FITS itself asks for.

    `origin` says where its numbers come from; `facts` are what the stage says of this file: conventions, and
    numbers under ``ESO QC``.
    """
    failed = ", ".join(check.name for check in origin.checks if not check.passed)
    cards = [
        Card("IRLOS VERDICT", f"QC FAILED: {failed}" if failed else ""),
        Card("IRLOS NOTICE", origin.notice),
        *_observed(origin.recordings[:1]),
        Card("DATE", origin.provenance.finished.partition("+")[0], "when the numbers were made (UTC)"),
        *_product(origin),
        *_inputs(origin),
        *_parameters(origin),
        *_irlos(origin.recordings[:1]),
        *facts,
        *_quality(origin.checks),
    ]
    unique: dict[str, Card] = {}
    for card in cards:
        if card.value != "" and not (isinstance(card.value, float) and not math.isfinite(card.value)):
            unique.setdefault(card.key, card)
    return list(unique.values())


def _observed(recordings: Sequence[Recorded]) -> Iterator[Card]:
    for one in recordings:
        yield from (Card(key, value) for key, value in one.cards.items())
        yield Card("OBJECT", one.target, "target")
        yield Card("INSTRUME", one.instrument.upper(), "profile of the instrument")
        if one.start:
            yield Card("DATE-OBS", one.start, "begin of the first frame (UTC)")
        start = one.cards.get("DATE-OBS", one.start)
        if start:
            yield Card("MJD-OBS", _mjd(str(start)), f"[d] {start}")
        yield Card("EXPTIME", one.exposure_s, "[s] of a frame")


def _mjd(moment: str) -> float:
    from astropy.time import Time

    try:
        return round(float(Time(moment, scale="utc").mjd), 8)
    except ValueError:
        return math.nan


def _product(origin: Origin) -> Iterator[Card]:
    made = origin.provenance
    software = f"irlos_pipe/{made.software.get('irlos_pipe', '')}"
    yield Card("ESO PRO CATG", origin.category, "category of the product")
    yield Card("ESO PRO TYPE", "REDUCED", "type of the product")
    yield Card("ESO PRO SCIENCE", False, "no science exposure")
    yield Card("ESO PRO DATANCOM", len(origin.recordings), "recordings combined")
    yield Card("ESO PRO REC1 ID", made.recipe, "recipe")
    yield Card("ESO PRO REC1 DRS ID", software, "software and revision")
    yield Card("ESO PRO REC1 PIPE ID", software, "software and revision")
    yield Card("IRLOS STAGE", origin.stage, "stage that made the numbers")
    yield Card("IRLOS KEY", made.key[:SHA_DIGITS], "checksum of all it depends on")
    yield Card("IRLOS COMMAND", made.command, "command line")


def _inputs(origin: Origin) -> Iterator[Card]:
    """The files: recordings by role, whatever lies next to them as calibration, side-cars as such."""
    owners = {one.input for one in origin.recordings}
    roles = {(one.input, one.file): one.role for one in origin.recordings}
    counts = {"RAW": 0, "CAL": 0}
    for entry in origin.provenance.inputs[:MAX_FILES]:
        owner, path = entry.label.partition("/")[0], PurePosixPath(entry.label)
        if owners and owner not in owners:
            continue
        role = roles.get((owner, path.name), "")
        kind = "RAW" if role else "CAL"
        counts[kind] += 1
        key = f"ESO PRO REC1 {kind}{counts[kind]}"
        yield Card(f"{key} NAME", path.name, "file")
        beside = "ACQUISITION" if path.suffix in SIDECAR_SUFFIXES else _word(path.stem)
        yield Card(f"{key} CATG", role.upper() or beside, "category")
        yield Card(f"{key} SHA256", entry.sha256[:SHA_DIGITS], f"first {SHA_DIGITS} digits")


def _parameters(origin: Origin) -> Iterator[Card]:
    given = ((".".join(path), value) for path, value in flat({origin.stage: origin.config or {}}))
    told = [(name, value) for name, value in given if value not in (None, "", [], {})]
    for number, (name, value) in enumerate(told[:MAX_PARAMETERS], 1):
        yield Card(f"ESO PRO REC1 PARAM{number} NAME", name)
        yield Card(f"ESO PRO REC1 PARAM{number} VALUE", str(value))


def _irlos(recordings: Sequence[Recorded]) -> Iterator[Card]:
    for one in recordings:
        yield Card("IRLOS RECORDING", one.name, "first of those combined")
        yield Card("IRLOS MODE", one.mode, "read-out mode")
        yield Card("IRLOS FRAMES", one.frames, "frames recorded")
        yield Card("IRLOS FRAMES REJECTED", one.frames_rejected, "of them")
        yield Card("IRLOS FRAMERATE", one.frame_rate_hz, "[Hz]")
        yield Card("IRLOS PIXSCALE", one.pixel_scale_mas, "[mas] per pixel")
        yield Card("IRLOS WAVELENGTH", one.wavelength_nm, "[nm] mean of the photons")
        yield Card("IRLOS MAG J", one.mag_j, "[mag] of the star")
        yield Card("IRLOS DIVERSITY SOURCE", one.diversity_source)
        for noll, nm in sorted(one.diversity_nm.items()):
            yield Card(f"IRLOS DIVERSITY NOLL{noll}", nm, "[nm] RMS, introduced")
        yield Card("IRLOS DEROTATOR", one.derotator_angle_deg, "[deg] angle of the derotator")
        yield Card("IRLOS PARANG", one.parallactic_angle_deg, "[deg] parallactic angle")
        yield Card("IRLOS ALTITUDE", one.altitude_deg, "[deg] of the telescope")
        yield Card("IRLOS PUPIL ROTATION", one.pupil_rotation_deg, "[deg] anticlockwise, on the detector")


def _quality(checks: Sequence[Check]) -> Iterator[Card]:
    """All checks by name; a name that several recordings have is numbered."""
    failed = [check.name for check in checks if not check.passed]
    yield Card("ESO QC CHECKS", len(checks), "quality checks")
    yield Card("ESO QC FAILED", len(failed), "of them")
    yield Card("ESO QC PASSED", not failed, "all checks passed")
    counts: dict[str, int] = {}
    for check in checks:
        key = qc_keyword(check.name)
        counts[key] = counts.get(key, 0) + 1
        numbered = key if counts[key] == 1 else f"{key} {counts[key]}"
        value = float(check.value)
        yield Card(numbered, value if math.isfinite(value) else str(value), _limits(check))


def qc_keyword(name: str) -> str:
    """Return the keyword of a check or number: ``ESO QC`` and the last part of its `name` in capitals."""
    words = [_word(word) for word in re.split(r"[^A-Za-z0-9_-]+", name.split("/")[-1])]
    kept = [word for word in words if word and word not in FEW_WORDS]
    return " ".join(["ESO QC", *kept])


def _word(text: str) -> str:
    return re.sub(r"[^A-Z0-9_-]", "", text.upper().replace(".", "_"))


def _limits(check: Check) -> str:
    unit = f"[{check.unit}] " if check.unit not in ("", "1") else ""
    low = "" if check.low is None else f"{check.low:.4g} <= "
    high = "" if check.high is None else f" <= {check.high:.4g}"
    return f"{unit}{'ok' if check.passed else 'FAILED'}: {low}value{high}"


@dataclass(frozen=True)
class Column:
    name: str  # in CSV, with the unit, for example ``offset_nm``; FITS has it in capitals without
    unit: str
    values: np.ndarray
    description: str = ""
    pattern: str = ""  # format of a number in CSV


@dataclass(frozen=True)
class Table:
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
        columns = [
            fits.Column(
                column.name.removesuffix(f"_{column.unit}").upper(),
                "J" if column.values.dtype.kind == "i" else "D",
                unit=column.unit or None,
                array=column.values,
            )
            for column in table.columns
        ]
        hdu = fits.BinTableHDU.from_columns(columns, name=table.name)
        for number, column in enumerate(table.columns, 1):
            if column.description:
                hdu.header[f"TCOMM{number}"] = ascii_text(column.description)
        if table.note:
            hdu.header["COMMENT"] = ascii_text(table.note)
        return fits_content([hdu], cards)
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


# -- FITS files with full headers and checksums --------------------------------------------------------


def fits_content(hdus: Sequence[fits.hdu.base.ExtensionHDU], cards: Iterable[Card]) -> bytes:
    """Return a FITS file: a primary header of `cards`, and the `hdus` behind it.

    Words that do not fit into a hierarchical card go on in cards of the same keyword with a number; one
    word, as a path, loses its beginning.
    """
    primary = fits.PrimaryHDU()
    for card in cards:
        for one in _in_words(card):
            plain = _is_plain(one)
            keyword = one.key if plain else f"HIERARCH {one.key}"
            room = _room(one)
            value = _fitting(one.value, room)
            left = room - len(_written(value)) - 3
            primary.header[keyword] = (value, ascii_text(one.comment)[: max(left, 0)])
    stream = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fits.verify.VerifyWarning)
        fits.HDUList([primary, *hdus]).writeto(stream, checksum=True, output_verify="exception")
    return stream.getvalue()


def ascii_text(text: str) -> str:
    """Return a `text` in the letters that FITS has."""
    plain = text.translate(SPELT).encode("ascii", "replace").decode()
    return "".join(letter if letter.isprintable() else "?" for letter in plain)


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
