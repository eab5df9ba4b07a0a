"""The record of a loop: lines of JSON, and a view of them in SQLite.

The lines are the record. A line that cannot be written, for lack of space above all, waits in memory and is
written, in order, as soon as it can be: the loop goes on meanwhile. The database is filled from the lines and
can be made from them again; what is wrong with it is reported and does not stop the loop.
"""

import json
import math
import os
import sqlite3
import time
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any

from irlos_pipe.control.controller import BOOTSTRAP, TRACKING, ControllerState
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.files.json import jsonable

SCHEMA, SCHEMA_VERSION = "irlos-focus", 2  # in version 1 `sigma_nm` was the error by photons
SHADOW = "shadow"

# Reasons of the program, besides those of `Focus`.
WINDOW, LATE, STALE, INCOMPLETE = "window", "late", "stale_calibration", "incomplete"
FAILED, FROZEN, OLD = "failed", "frozen", "old"

LINES, DATABASE = "focus.jsonl", "focus.sqlite"
TABLES = """
CREATE TABLE IF NOT EXISTS records (
    sequence INTEGER PRIMARY KEY, unix_s REAL, defocus_nm REAL, sigma_nm REAL, valid INTEGER, offset_nm REAL,
    mode TEXT, reasons TEXT, latency_ms REAL, calibration TEXT, line TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS events (position INTEGER PRIMARY KEY, line TEXT NOT NULL);
"""
COLUMNS = ["sequence", "unix_s", "defocus_nm", "sigma_nm", "valid", "offset_nm"]
COLUMNS += ["mode", "reasons", "latency_ms", "calibration", "line"]
COMMIT_S = 1.0  # between transactions of the database
BLOCK_BYTES = 1 << 16  # of the lines that are read at once from the end
LONGEST_LINE = 1 << 20  # bytes of a line; records have a thousand
RECENT_BYTES = 1 << 26  # bytes at the end of the file in which recent lines are looked for


@dataclass(frozen=True, kw_only=True)
class Record:
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


@dataclass(frozen=True)
class Earlier:
    """What loops on this output have measured."""

    since_unix_s: float = 0.0  # when the first one started
    recordings: frozenset[str] = frozenset()  # of which there are records
    last: str = ""  # the one of the last record


class Journal:
    """Appends records to the files of a folder, which this loop alone owns.

    `last` is the last sound record that stands in the file, if any; `damaged` counts the lines after it that
    are none, the last one included if it was not finished and is cut off; `problem` says why lines cannot be
    written.

    Raises `InputDataError` if the file of lines cannot be opened, or is none of a focus loop.
    """

    def __init__(self, folder: Path):
        self._path = folder / LINES
        self._waiting: deque[str] = deque()
        self.last: Record | None = None
        self.problem, self.damaged = "", 0
        try:
            self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
        except OSError as error:
            raise InputDataError(
                f"{self._path}: cannot be opened: {error.strerror}; move it away or choose another output"
            ) from None
        self._end = os.fstat(self._file).st_size
        self._find_last()
        self._cut()
        self._database = _Database(folder / DATABASE, self._path)
        self._database.fill()

    @property
    def waiting(self) -> int:
        """Lines that could not be written yet."""
        return len(self._waiting)

    @property
    def earlier(self) -> Earlier | None:
        """What has been measured; None if there is no record yet."""
        if self.last is None:
            return None
        noted_unix_s, names = list[float](), set[str]()
        with open(self._path, "rb") as stream:
            for line in stream:
                with suppress(ValueError, TypeError, LookupError):
                    content = content_of(line)
                    if "event" in content:
                        noted_unix_s.append(float(content["unix_s"]))
                    else:
                        names.add(str(content.get("recording", "")))
        return Earlier(min(noted_unix_s, default=0.0), frozenset(names) - {""}, self.last.recording)

    def recent(self, since_unix_s: float) -> list[tuple[float, str]]:
        """Return lines with the times at which they were written, from `since_unix_s` on."""
        found, size = list[tuple[float, str]](), 0
        for line in self._backwards():
            size += len(line)
            if size > RECENT_BYTES:
                break
            with suppress(ValueError, TypeError, LookupError):
                content = content_of(line)
                written_s = float(content.get("recorded_unix_s", content["unix_s"]))
                if written_s >= since_unix_s:
                    found.append((written_s, line.decode() + "\n"))
        return found[::-1]

    def add(self, record: Record) -> str:
        return self._append(record.line())

    def event(self, text: str) -> str:
        """Append something that happened, a `text` of one line; return its line."""
        return self._append(event_line(self.last.sequence if self.last else 0, time.time(), text))

    def flush(self) -> None:
        """Write what waits, as far as it can be written."""
        while self._waiting and self._write(self._waiting[0]):
            self._waiting.popleft()
        if time.monotonic() - self._database.filled_s >= COMMIT_S:
            self._database.fill()

    def news(self) -> str:
        """Return what has become of the database since the last call, if it has to be reported."""
        told, self._database.news = self._database.news, ""
        return told

    def close(self) -> None:
        self.flush()
        self._database.fill()
        self._database.release()
        os.close(self._file)

    def _append(self, line: str) -> str:
        self._waiting.append(line)
        self.flush()
        return line

    def _write(self, line: str) -> bool:
        """Write a line whole or not at all."""
        content = line.encode()
        try:
            written = os.pwrite(self._file, content, self._end)
        except OSError as error:
            self.problem, written = error.strerror or str(error), 0
        if written < len(content):
            self.problem = self.problem or "no space left"
            with suppress(OSError):
                os.ftruncate(self._file, self._end)
            return False
        self._end += written
        self.problem = ""
        return True

    def _find_last(self) -> None:
        """Look for the last sound record from the end; a file without any line of a loop is another's."""
        ours = self._end == 0
        for line in self._backwards():
            try:
                self.last = record_of(line)
                ours = True
            except ValueError:
                self.damaged += 1
            if self.last is not None:
                return
        if not ours:
            raise InputDataError(f"{self._path}: not the record of a focus loop; choose another output")

    def _cut(self) -> None:
        """Cut off a last line that was not finished."""
        whole = self._end
        while whole and os.pread(self._file, 1, whole - 1) != b"\n":
            start = max(0, whole - BLOCK_BYTES)
            whole = start + os.pread(self._file, whole - start, start).rfind(b"\n") + 1
        if whole < self._end:
            os.ftruncate(self._file, whole)
            self._end = whole

    def _backwards(self) -> Iterator[bytes]:
        """Lines from the last one on; what is too long for one is damaged, and only a part of it comes."""
        end, rest = self._end, b""
        while end:
            start = max(0, end - BLOCK_BYTES)
            rest, *lines = (os.pread(self._file, end - start, start) + rest[:LONGEST_LINE]).split(b"\n")
            yield from (line for line in reversed(lines) if line)
            end = start
        if rest:
            yield rest


class _Database:
    """The tables: a view of the lines, brought up to date every second."""

    def __init__(self, path: Path, lines: Path):
        self._path, self._lines, self.filled_s = path, lines, time.monotonic()
        self._connection: sqlite3.Connection | None = None
        self._position, self._problem, self.news = 0, "", ""

    def fill(self) -> None:
        """Add what the lines have and the tables lack; what is no database of a loop is set aside."""
        self.filled_s, problem = time.monotonic(), ""
        try:
            try:
                self._add()
            except sqlite3.OperationalError:
                raise
            except sqlite3.DatabaseError as error:
                self.news = f"{self._path}: {error}; set aside as {self._set_aside()}, and made anew"
                self._add()
        except sqlite3.OperationalError as error:  # it is locked, or cannot be written: perhaps later
            problem = str(error)
            self.release()
        except (sqlite3.DatabaseError, OSError) as error:
            problem = str(error)
        if problem != self._problem:
            self.news = f"{self._path}: {problem or 'up to date again'}"
        self._problem = problem

    def release(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            with suppress(sqlite3.Error):
                connection.close()

    def _add(self) -> None:
        """Add the lines after the last position; a line that is damaged is left out."""
        connection = self._connection or self._opened()
        position = self._position
        with connection, open(self._lines, "rb") as stream:
            stream.seek(position)
            for line in stream:
                if not line.endswith(b"\n"):
                    break
                position += len(line)
                with suppress(ValueError):
                    _insert(connection, position, line.decode(), record_of(line))
        self._position = position

    def _opened(self) -> sqlite3.Connection:
        if self._path.is_symlink() or (self._path.exists() and not self._path.is_file()):
            raise OSError("a link, or no file: not written")
        self._connection = connection = sqlite3.connect(self._path, timeout=0.0)
        tables = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
        names = {name for (name,) in tables}
        columns = [name for (name,) in connection.execute("SELECT name FROM pragma_table_info('records')")]
        if names and (names != {"records", "events"} or columns != COLUMNS):
            raise sqlite3.DatabaseError("not the tables of a focus loop")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = OFF")
        connection.executescript(TABLES)
        (known,) = connection.execute("SELECT coalesce(max(position), 0) FROM events").fetchone()
        self._position = known if known <= self._lines.stat().st_size else 0
        return connection

    def _set_aside(self) -> str:
        """Give the file and what belongs to it another name; returns that."""
        self.release()
        number = 1
        while (name := self._path.with_name(f"{self._path.name}.damaged-{number}")).exists():
            number += 1
        for suffix in ("-wal", "-shm", ""):
            with suppress(OSError):
                os.replace(f"{self._path}{suffix}", f"{name}{suffix}")
        return name.name


def _insert(connection: sqlite3.Connection, position: int, line: str, record: Record | None) -> None:
    if record is None:
        connection.execute("INSERT OR REPLACE INTO events VALUES (?, ?)", (position, line))
        return
    row = {name: getattr(record, name) for name in COLUMNS[:-1]} | {"reasons": " ".join(record.reasons)}
    marks = ", ".join("?" * len(COLUMNS))
    connection.execute(f"INSERT OR REPLACE INTO records VALUES ({marks})", [*row.values(), line])
