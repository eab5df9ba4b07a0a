"""What the loop leaves behind of every exposure."""

from __future__ import annotations

import json
import math
from dataclasses import MISSING, asdict, dataclass, fields
from typing import Any

from irlos_pipe.control.controller import BOOTSTRAP, TRACKING, ControllerState
from irlos_pipe.files.json import jsonable

SCHEMA, SCHEMA_VERSION = "irlos-focus", 2  # in version 1 `sigma_nm` was the error by photons
SHADOW = "shadow"

# Reasons of the program, besides those of `Focus`.
WINDOW, LATE, STALE, INCOMPLETE = "window", "late", "stale_calibration", "incomplete"
FAILED, FROZEN, OLD = "failed", "frozen", "old"


@dataclass(frozen=True, kw_only=True)
class Record:
    """One exposure."""

    sequence: int  # from 1, over all starts of the loop
    exposure: int
    counter: int  # of the first read
    unix_s: float  # of the first read
    reads: int
    reads_late: int  # these since the exposure before
    reads_doubled: int
    reads_missing: int
    reads_damaged: int
    defocus_nm: float  # to misfit, see `Measurement`
    sigma_nm: float  # with errors that exposures share, see `SharedErrors`; NaN if these are not known
    tip_nm: float
    tilt_nm: float
    flux_e: float
    background_e: float
    chi2_nu: float
    misfit: float
    valid: bool
    reasons: tuple[str, ...]  # why it is not valid
    mode: str  # bootstrap, tracking or shadow
    offset_nm: float  # commanded after this exposure [nm RMS]
    commanded: bool  # whether this exposure changed it; if not, it is held
    held: str  # why a valid measurement was not used: settling, outside, open
    clipped: bool
    settling: int  # see `ControllerState`
    outside: int
    latency_ms: float  # from the arrival of the last read to this record
    calibration: str
    sigma_photon_nm: float = math.nan  # the part of sigma_nm by photons and read-out
    recording: str = ""  # that the reads belong to, where each has a counter of its own
    recorded_unix_s: float = math.nan  # by the clock of the loop

    def line(self) -> str:
        """Return the record as one line of JSON."""
        return _line(asdict(self))

    @property
    def state(self) -> ControllerState:
        """What the controller remembers after this exposure."""
        mode = BOOTSTRAP if self.mode == SHADOW else self.mode
        return ControllerState(self.offset_nm, mode, self.settling, self.outside)


def event_line(sequence: int, unix_s: float, event: str) -> str:
    """Return an `event` after record `sequence`, at `unix_s`, as one line of JSON."""
    return _line({"after": sequence, "unix_s": unix_s, "event": event})


def content_of(line: str | bytes) -> dict[str, Any]:
    """Return the keys of the `line` of a record or an event.

    Raises `ValueError` if it is neither, or damaged.
    """
    try:
        content: Any = json.loads(line)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        raise ValueError("not a record of a focus loop")
    return content


def record_of(line: str | bytes) -> Record | None:
    """Return the record in a line; None for an event.

    Raises `ValueError` if the `line` is neither, or states what no loop can go on from.
    """
    content = content_of(line)
    if "event" in content:
        return None
    try:
        known = [one for one in fields(Record) if one.name in content or one.default is MISSING]
        values = {one.name: content[one.name] for one in known}  # older records lack the keys with a default
        values |= {name: float("nan") for name, value in values.items() if value is None}
        record = Record(**values | {"reasons": tuple(values["reasons"])})
        if _is_sound(record):
            return record
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"a damaged record ({error})") from None
    raise ValueError("a damaged record")


def _is_sound(record: Record) -> bool:
    """Whether the next exposure can go on from a record."""
    numbers = (record.sequence, record.exposure, record.counter, record.settling, record.outside)
    whole = all(type(one) is int and abs(one) < 1 << 63 for one in numbers)
    stated = (*record.reasons, record.recording, record.calibration, record.held)
    timed = isinstance(record.unix_s, float | int) and isinstance(record.recorded_unix_s, float | int)
    known = record.mode in (BOOTSTRAP, TRACKING, SHADOW) and all(isinstance(one, str) for one in stated)
    first = record.sequence > 0 and min(record.settling, record.outside) >= 0
    return whole and known and timed and first and math.isfinite(record.offset_nm)


def _line(content: dict[str, Any]) -> str:
    head = {"schema": SCHEMA, "schema_version": SCHEMA_VERSION}
    return json.dumps(jsonable(head | content), allow_nan=False, separators=(",", ":")) + "\n"
