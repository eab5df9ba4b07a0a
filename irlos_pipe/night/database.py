"""The SQLite file of a tree: descriptions of recordings, and the numbers and verdicts of all runs.

Everything in it can be read from the products: if the file is missing, the next `irlos night` makes it again.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from irlos_pipe.conventions.errors import InputDataError, IrlosError, Locked
from irlos_pipe.files.json import json_text
from irlos_pipe.files.locks import has_locks
from irlos_pipe.night.description import Description
from irlos_pipe.night.grouping import Group
from irlos_pipe.night.measurements import Measurements

NAME = "trend.sqlite"
SCHEMA_VERSION = 2
SCHEMA = """
CREATE TABLE IF NOT EXISTS recordings (
    file TEXT PRIMARY KEY,      -- absolute path of the data file
    stamp TEXT NOT NULL,        -- sizes and times of the files that the description depends on
    description TEXT NOT NULL   -- JSON
);
CREATE TABLE IF NOT EXISTS runs (
    run TEXT PRIMARY KEY,       -- <night>/<group>/<recipe>
    night TEXT NOT NULL,        -- date of the evening, ISO
    kind TEXT NOT NULL,         -- calibration, ramp, derotator, psf, two_by_two
    recipe TEXT NOT NULL,
    start_unix_s REAL,          -- start of the first recording
    configuration TEXT NOT NULL,
    target TEXT NOT NULL,
    status TEXT NOT NULL,       -- ok, qc_failed, partial
    checks_failed TEXT NOT NULL,-- JSON list
    verdict TEXT,               -- of diagnose: none, effect, unknown
    effects TEXT NOT NULL,      -- JSON list of the effects found by diagnose
    model TEXT NOT NULL,        -- versions of software and stages
    key TEXT NOT NULL           -- of the last product: checksum of everything it depends on
);
CREATE TABLE IF NOT EXISTS numbers (
    run TEXT NOT NULL REFERENCES runs(run) ON DELETE CASCADE,
    name TEXT NOT NULL,         -- noll_4_nm, defocus_bias_nm, seeing_arcsec, gap_before ...
    value REAL NOT NULL,
    sigma REAL,
    PRIMARY KEY (run, name)
);
CREATE INDEX IF NOT EXISTS numbers_by_name ON numbers (name);
CREATE TABLE IF NOT EXISTS checks (
    run TEXT NOT NULL REFERENCES runs(run) ON DELETE CASCADE,
    stage TEXT NOT NULL,
    name TEXT NOT NULL,
    value REAL,                 -- NULL where it is not a number: the check failed
    unit TEXT NOT NULL,
    low REAL,
    high REAL,
    passed INTEGER NOT NULL,
    message TEXT NOT NULL
);
CREATE INDEX IF NOT EXISTS checks_by_run ON checks (run);
"""
# Version 1 had no checks: without their key, all runs are read again from the products.
FORGET_KEYS = "UPDATE runs SET key = ''"
# A row that a run can have; others were made by somebody else, and are left out.
SOUND = "date(night) = night AND run LIKE '%/%/%' AND coalesce(start_unix_s, 0) BETWEEN 0 AND 4102444800"
DESCRIPTION = TypeAdapter(Description)
LOCKED_S = 30.0  # how long another program may hold the file
# For a night without times: local midnight of Paranal, which comes after that of its date.
MIDNIGHT = "CAST(strftime('%s', night, '+1 day', '+282 minutes') AS REAL)"


@dataclass(frozen=True)
class Point:
    """One number of one run.

    Attributes
    ----------
    unix_s : float
        Start of the recording [s since 1970]; the middle of the night where it is not known.
    sigma : float or None
        Standard error.
    """

    run: str
    night: str
    unix_s: float
    name: str
    recipe: str
    configuration: str
    value: float
    sigma: float | None


@dataclass(frozen=True)
class Verdict:
    """The verdict of `diagnose` on a recording, and the effects it found."""

    run: str
    night: str
    target: str
    verdict: str
    effects: tuple[str, ...]

    @property
    def group(self) -> str:
        """Name of the group in its night."""
        return self.run.split("/")[1]


class Database:
    """The tables of one tree, see `SCHEMA`; opened with `opened`, `copied` or `existing`."""

    def __init__(self, connection: sqlite3.Connection):
        self._connection = connection

    def description(self, file: Path, stamp: str) -> Description | None:
        """Return the description of a `file`; None when the file is new or has another `stamp`."""
        query = "SELECT description FROM recordings WHERE file = ? AND stamp = ?"
        row = self._connection.execute(query, (str(file), stamp)).fetchone()
        return None if row is None else _description(row[0])  # None as well if it was damaged: read anew

    def descriptions(self) -> list[Description]:
        """Return the descriptions of all nights whose files still exist."""
        rows = self._connection.execute("SELECT file, description FROM recordings ORDER BY file")
        return list(filter(None, (_description(content) for file, content in rows if Path(file).is_file())))

    def add_description(self, file: Path, stamp: str, description: Description) -> None:
        """Store the `description` of a `file` under its `stamp`.

        It is committed at once: reading an archive takes long and may be interrupted.
        """
        self._connection.execute(
            "INSERT OR REPLACE INTO recordings VALUES (?, ?, ?)",
            (str(file), stamp, json_text(asdict(description), None)),
        )
        self._connection.commit()

    def run_key(self, run: str) -> str:
        """Return the key of the products whose numbers are stored; "" when there are none."""
        row = self._connection.execute("SELECT key FROM runs WHERE run = ?", (run,)).fetchone()
        return row[0] if row else ""

    def store_run(self, run: str, group: Group, recipe: str, measured: Measurements) -> None:
        """Store the numbers of a run and remove those of its earlier products.

        Parameters
        ----------
        run : str
            ``<night>/<group>/<recipe>``.
        group : Group
            The recordings.
        recipe : str
            Name of the recipe.
        measured : Measurements
            Status, numbers and verdict.
        """
        first = group.first
        for table in ("checks", "numbers", "runs"):
            self._connection.execute(f"DELETE FROM {table} WHERE run = ?", (run,))
        self._connection.execute(
            "INSERT INTO runs VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                run,
                group.night,
                group.kind,
                recipe,
                first.start_unix_s,
                first.configuration,
                first.target,
                measured.status,
                json.dumps(measured.checks_failed),
                measured.verdict,
                json.dumps(measured.effects),
                measured.model,
                measured.key,
            ),
        )
        rows = [(run, name, value, sigma) for name, (value, sigma) in measured.numbers.items()]
        self._connection.executemany("INSERT INTO numbers VALUES (?, ?, ?, ?)", rows)
        checks = [
            (run, stage, one.name, one.value, one.unit, one.low, one.high, one.passed, one.message)
            for stage, one in measured.checks
        ]
        self._connection.executemany("INSERT INTO checks VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", checks)

    def failed_calibrations(self, recipes: Iterable[str]) -> dict[str, str]:
        """Return why calibrations failed their quality check, by ``<night>/<group>``.

        Parameters
        ----------
        recipes : iterable of str
            Names of the recipes that judge them.
        """
        rows = self._connection.execute(
            "SELECT run, recipe, CASE WHEN json_valid(checks_failed) THEN checks_failed ELSE '[]' END"
            " FROM runs WHERE kind = 'calibration' AND status = 'qc_failed'"
        )
        wanted = set(recipes)
        return {
            run.rpartition("/")[0]: "failed " + ", ".join(map(str, json.loads(checks) or ["?"]))
            for run, recipe, checks in rows
            if recipe in wanted
        }

    def points(self, until: str = "") -> list[Point]:
        """Return the numbers of runs that passed in order of time, up to the night `until` (ISO date).

        All nights if `until` is empty. Those of runs that failed their quality check stay out.
        """
        rows = self._connection.execute(
            f"SELECT run, night, coalesce(start_unix_s, {MIDNIGHT}), name, recipe,"
            " configuration, value, sigma FROM numbers JOIN runs USING (run)"
            f" WHERE {SOUND} AND typeof(value) = 'real' AND typeof(sigma) IN ('real', 'null')"
            " AND status != 'qc_failed' ORDER BY 3, run, name"
        )
        return [one for one in (Point(*row) for row in rows) if not until or one.night <= until]

    def verdicts(self, until: str = "") -> list[Verdict]:
        """Return the verdicts of `diagnose` in order of time, up to the night `until` (all if empty)."""
        rows = self._connection.execute(
            "SELECT run, night, target, verdict, effects FROM runs"
            f" WHERE {SOUND} AND verdict IS NOT NULL"
            " AND CASE WHEN json_valid(effects) THEN json_type(effects) = 'array' END"
            " ORDER BY night, start_unix_s, run"
        )
        found = (
            Verdict(run, night, target, verdict, tuple(json.loads(effects)))
            for run, night, target, verdict, effects in rows
        )
        return [one for one in found if not until or one.night <= until]


@contextmanager
def opened(tree: Path) -> Iterator[Database]:
    """Open the database of a tree, creating it if necessary; the block is one transaction.

    Raises
    ------
    IrlosError
        When the file cannot be read or written, or is not such a database; it is unchanged then.
    """
    with _connected(tree) as connection:
        yield Database(connection)


@contextmanager
def copied(tree: Path) -> Iterator[Database]:
    """Give a copy in memory of the database of a tree, empty if there is none; nothing is written."""
    connection = sqlite3.connect(":memory:")
    try:
        if (tree / NAME).is_file():
            with _connected(tree) as stored:
                stored.backup(connection)
        _require_schema(connection, tree / NAME)
        yield Database(connection)
    finally:
        connection.close()


@contextmanager
def existing(tree: Path) -> Iterator[Database]:
    """Open the database of a tree for reading.

    Raises
    ------
    InputDataError
        When there is none.
    """
    if not (tree / NAME).is_file():
        raise InputDataError(
            f"{tree}: not the tree of irlos night (no {NAME}); make one with: "
            "irlos night NIGHT_DIR --output TREE"
        )
    with opened(tree) as database:
        yield database


@contextmanager
def _connected(tree: Path) -> Iterator[sqlite3.Connection]:
    path = tree / NAME
    if path.is_symlink() or (path.exists() and not path.is_file()):
        raise IrlosError(
            f"{path}: no file of our own; move it away, and the next irlos night makes a new one"
        )
    try:
        # Without locks on the disk SQLite would wait for one in vain; the tree has its owner.
        nolock = "" if has_locks(tree) else "?nolock=1"
        connection = sqlite3.connect(path.absolute().as_uri() + nolock, timeout=LOCKED_S, uri=True)
        try:
            _require_schema(connection, path)
            connection.execute("PRAGMA foreign_keys = ON")
            with connection:
                yield connection
        finally:
            connection.close()
    except sqlite3.Error as error:
        if getattr(error, "sqlite_errorcode", None) in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            raise Locked(f"{path}: in use by another program; close it and run again") from error
        raise IrlosError(
            f"{path}: {error}; the products hold everything in it: move the file away, and the next "
            "irlos night makes it again"
        ) from error


def _require_schema(connection: sqlite3.Connection, path: Path) -> None:
    """Create the tables of a new file; refuse those of a newer version."""
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if version > SCHEMA_VERSION:
        raise IrlosError(f"{path}: written by a newer irlos_pipe (schema {version}); use that version")
    if version < SCHEMA_VERSION:
        connection.executescript(SCHEMA)
        with connection:  # else a copy would wait for the end of this transaction for ever
            connection.execute(FORGET_KEYS)
            connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")


def _description(content: Any) -> Description | None:
    """The description of a recording; None if it is damaged."""
    try:
        found = DESCRIPTION.validate_json(content)
        date.fromisoformat(found.night)  # the name of a folder is made of it
    except ValueError:
        return None
    return found
