"""The record of a loop: lines of JSON, and the same in SQLite.

The lines are the record; the database can be made from them again. A line that cannot be written, for lack of
space above all, waits in memory and is written, in order, as soon as it can be: the loop goes on meanwhile.
"""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.focus.record import Record, event_line, record_of

LINES, DATABASE = "focus.jsonl", "focus.sqlite"
TABLES = """
CREATE TABLE IF NOT EXISTS records (
    sequence INTEGER PRIMARY KEY, unix_s REAL, defocus_nm REAL, sigma_nm REAL, valid INTEGER, offset_nm REAL,
    mode TEXT, reasons TEXT, latency_ms REAL, calibration TEXT, line TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS events (position INTEGER PRIMARY KEY, line TEXT NOT NULL);
"""
COLUMNS = 11
COMMIT_S = 1.0  # between transactions
TAIL_BYTES = 1 << 16  # at the end of the lines in which the last record is looked for


RECENT_BYTES = 1 << 26  # at the end of the lines in which recent ones are looked for


@dataclass(frozen=True)
class Earlier:
    """What loops on this output have measured.

    Attributes
    ----------
    since_unix_s : float
        When the first one started.
    recordings : frozenset of str
        Of which there are records.
    last : str
        The one of the last record.
    """

    since_unix_s: float = 0.0
    recordings: frozenset[str] = frozenset()
    last: str = ""


class Journal:
    """Appends records to the files of a folder.

    Parameters
    ----------
    folder : Path
        Owned by this loop alone.

    Attributes
    ----------
    last : Record or None
        The last record that stands in the file.
    waiting : int
        Lines that could not be written yet.

    Raises
    ------
    InputDataError
        If the files are there and are none of a focus loop.
    """

    def __init__(self, folder: Path):
        self._path = folder / LINES
        self._waiting: deque[str] = deque()
        self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        self._end = self._mend()
        self.last = self._last_record()
        self.problem = ""
        self._database = _Database(folder / DATABASE)
        self._database.fill(self._path)

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
        with open(self._path, encoding="utf-8", errors="replace") as stream:
            for content in map(json.loads, stream):
                if "event" in content:
                    noted_unix_s.append(content["unix_s"])
                else:
                    names.add(content.get("recording", ""))
        return Earlier(min(noted_unix_s, default=0.0), frozenset(names) - {""}, self.last.recording)

    def recent(self, since_unix_s: float) -> list[tuple[float, str]]:
        """Return lines with the times at which they were written.

        Parameters
        ----------
        since_unix_s : float
            Earlier ones are left out.
        """
        found = []
        for line in self._last_lines(RECENT_BYTES):
            content = json.loads(line)
            written_s = content.get("recorded_unix_s", content.get("unix_s") if "event" in content else None)
            if written_s is not None and written_s >= since_unix_s:
                found.append((written_s, line))
        return found

    def add(self, record: Record) -> str:
        """Append a `record`; return its line."""
        return self._append(record.line())

    def event(self, text: str) -> str:
        """Append something that happened, a `text` of one line; return its line."""
        last = self.last.sequence if self.last else 0
        return self._append(event_line(last, time.time(), text))

    def flush(self) -> None:
        """Write what waits, as far as it can be written."""
        while self._waiting:
            if not self._write(self._waiting[0]):
                return
            self._database.add(self._end, self._waiting.popleft())
        self._database.commit_if_due()

    def close(self) -> None:
        """Write what can be written and close the files."""
        self.flush()
        self._database.close()
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

    def _mend(self) -> int:
        """Cut off a last line that was not finished; return the length of the rest."""
        size = os.fstat(self._file).st_size
        start = max(0, size - TAIL_BYTES)
        tail = os.pread(self._file, size - start, start)
        end = start + tail.rfind(b"\n") + 1
        if end == 0 and size:
            raise InputDataError(f"{self._path}: not the record of a focus loop; choose another output")
        if end < size:
            os.ftruncate(self._file, end)
        return end

    def _last_record(self) -> Record | None:
        try:
            for line in reversed(self._last_lines(TAIL_BYTES)):
                if (record := record_of(line)) is not None:
                    return record
        except (ValueError, KeyError) as error:
            raise InputDataError(f"{self._path}: not the record of a focus loop ({error})") from None
        return None

    def _last_lines(self, most_bytes: int) -> list[str]:
        """The whole lines in the last bytes of the file."""
        start = max(0, self._end - most_bytes)
        lines = os.pread(self._file, self._end - start, start).decode(errors="replace").splitlines(True)
        return lines[1:] if start else lines


class _Database:
    """The tables; what goes wrong with them does not stop the loop, as the lines have it all."""

    def __init__(self, path: Path):
        self._path, self._committed_s = path, time.monotonic()
        self._connection = self._opened()
        self._behind = False

    def _opened(self) -> sqlite3.Connection:
        try:
            return self._connect()
        except sqlite3.DatabaseError:
            self._path.unlink()  # damaged: it is made from the lines again
            return self._connect()

    def _connect(self) -> sqlite3.Connection:
        connection = sqlite3.connect(self._path, timeout=0.0)
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = OFF")
        connection.executescript(TABLES)
        return connection

    def fill(self, lines: Path) -> None:
        """Add what the file of `lines` has and the tables lack."""
        query = "SELECT coalesce(max(sequence), 0) FROM records"
        (last,) = self._connection.execute(query).fetchone()
        position = 0
        with open(lines, "rb") as stream:
            for content in stream:
                position += len(content)
                if _sequence(content) > last:
                    self._insert(position, content.decode())
        self._connection.commit()
        self._behind, self._lines = False, lines

    def add(self, position: int, line: str) -> None:
        """Add the `line` that ends at a `position` of the file."""
        if self._behind:
            return
        try:
            self._insert(position, line)
        except sqlite3.Error:
            self._give_up_for_now()

    def commit_if_due(self) -> None:
        """Commit if the last time is a while ago."""
        if time.monotonic() - self._committed_s < COMMIT_S:
            return
        self._committed_s = time.monotonic()
        try:
            if self._behind:
                self.fill(self._lines)
            self._connection.commit()
        except sqlite3.Error:
            self._give_up_for_now()

    def close(self) -> None:
        """Commit and close."""
        self._committed_s = 0.0
        self.commit_if_due()
        self._connection.close()

    def _give_up_for_now(self) -> None:
        self._behind = True
        with suppress(sqlite3.Error):
            self._connection.rollback()

    def _insert(self, position: int, line: str) -> None:
        content = json.loads(line)
        if "event" in content:
            self._connection.execute("INSERT OR REPLACE INTO events VALUES (?, ?)", (position, line))
            return
        names = ("sequence", "unix_s", "defocus_nm", "sigma_nm", "valid", "offset_nm", "mode")
        row = [content[name] for name in names]
        row += [" ".join(content["reasons"]), content["latency_ms"], content["calibration"], line]
        marks = ", ".join("?" * COLUMNS)
        self._connection.execute(f"INSERT OR REPLACE INTO records VALUES ({marks})", row)


def _sequence(content: bytes) -> int:
    """Number of the record in a line; of an event, that of the record it follows, plus one."""
    line = json.loads(content)
    return int(line["sequence"]) if "sequence" in line else int(line["after"]) + 1
