"""The header of what is handed on: what was observed, with what it was reduced, and how good it is.

The cards follow ESO's data interface: the primary header is that of the first recording, ``ESO PRO`` says
what was made from what, ``ESO QC`` how good it is. What has no keyword there stands under ``IRLOS``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from irlos_pipe.product.product import Check
from irlos_pipe.product.results import Provenance, Recorded

Value = str | bool | int | float
FEW_WORDS = frozenset(("OF", "THE", "BY", "AS", "ABOUT", "A", "IN"))
SHA_DIGITS = 32  # of a checksum, as many as fit into a card
MAX_FILES, MAX_PARAMETERS = 400, 200  # that a header lists at most
SIDECAR_SUFFIXES = (".yaml", ".yml")


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
        yield Card(f"{key} CATG", role.upper() or _beside(path), "category")
        yield Card(f"{key} SHA256", entry.sha256[:SHA_DIGITS], f"first {SHA_DIGITS} digits")


def _beside(path: PurePosixPath) -> str:
    return "ACQUISITION" if path.suffix in SIDECAR_SUFFIXES else _word(path.stem)


def _parameters(origin: Origin) -> Iterator[Card]:
    flat = list(_flat(origin.config or {}, origin.stage))[:MAX_PARAMETERS]
    for number, (name, value) in enumerate(flat, 1):
        yield Card(f"ESO PRO REC1 PARAM{number} NAME", name)
        yield Card(f"ESO PRO REC1 PARAM{number} VALUE", str(value))


def _flat(config: Mapping[str, Any], above: str) -> Iterator[tuple[str, Any]]:
    for key, value in config.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{above}.{key}")
        elif value not in (None, "", []):
            yield f"{above}.{key}", value


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
