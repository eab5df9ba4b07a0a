"""The SQLite file of a tree: descriptions of recordings, numbers and verdicts of all runs; its dashboard.

Everything in it can be read from the products: if the file is missing, the next `irlos night` makes it again.
"""

import json
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError, IrlosError, Locked
from irlos_pipe.files.atomic import has_locks, write_bytes
from irlos_pipe.night.bands import Point
from irlos_pipe.night.numbers import Measurements

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
A_NUMBER = "typeof(value) = 'real' AND typeof(sigma) IN ('real', 'null')"  # others are not ours
LOCKED_S = 30.0  # how long another program may hold the file
# For a night without times: local midnight of Paranal, which comes after that of its date.
MIDNIGHT = "CAST(strftime('%s', night, '+1 day', '+282 minutes') AS REAL)"

# -- the dashboard for Grafana --
SOURCE = {"type": "frser-sqlite-datasource", "uid": "${DS_IRLOS}"}
WINDOW = "coalesce(start_unix_s, strftime('%s', night)) BETWEEN $__from / 1000 AND $__to / 1000"
COLUMNS, HEIGHT = 12, 8  # size of a panel; the page has 24 columns
POINTS = (  # every number is a line of its own
    "SELECT CAST(coalesce(start_unix_s, strftime('%s', night)) AS INTEGER) AS time, "
    "name || ' ' || recipe AS metric, value FROM numbers JOIN runs USING (run) "
    f"WHERE name IN ({{}}) AND status != 'qc_failed' AND {WINDOW} ORDER BY time"
)
SERIES = (
    (
        "NCPAs, Noll 4 to 11",
        POINTS.format(", ".join(f"'noll_{noll}_nm'" for noll in range(4, 12))),
        "lengthnm",
    ),
    ("RMS of the NCPAs", POINTS.format("'ncpa_nm'"), "lengthnm"),
    ("Defocus bias of ramps", POINTS.format("'defocus_bias_nm'"), "lengthnm"),
    ("Slope of ramps", POINTS.format("'ramp_slope'"), "none"),
    ("Seeing", POINTS.format("'seeing_arcsec'"), "arcsec"),
    ("Gap before and after diagnosis", POINTS.format("'gap_before', 'gap_after', 'gap_floor'"), "none"),
)
TABLES = (
    (
        "Checks that failed",
        "SELECT night, run, name, value, unit, low, high, message FROM checks JOIN runs USING (run) "
        f"WHERE NOT passed AND {WINDOW} ORDER BY night DESC, run, name",
    ),
    (
        "What the model lacks",
        "SELECT night, run, target, verdict, effects FROM runs "
        f"WHERE verdict IS NOT NULL AND {WINDOW} ORDER BY night DESC, run",
    ),
    (
        "Runs",
        f"SELECT night, run, kind, recipe, target, status, model FROM runs WHERE {WINDOW} "
        "ORDER BY night DESC, run",
    ),
)


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
        return self.run.split("/")[1]


class Database:
    """The tables of one tree, see `SCHEMA`; opened with `opened`, `copied` or `existing`."""

    def __init__(self, connection: sqlite3.Connection):
        self.connection = connection

    def description(self, file: Path, stamp: str) -> str | None:
        """Return what is stored of a `file`, JSON; None when the file is new or has another `stamp`."""
        query = "SELECT description FROM recordings WHERE file = ? AND stamp = ?"
        row = self.connection.execute(query, (str(file), stamp)).fetchone()
        return row and row[0]

    def descriptions(self) -> list[tuple[str, str]]:
        """Return the files of all nights with what is stored of them, JSON."""
        return self.connection.execute("SELECT file, description FROM recordings ORDER BY file").fetchall()

    def add_description(self, file: Path, stamp: str, description: str) -> None:
        """Store the `description` of a `file` under its `stamp`.

        It is committed at once: reading an archive takes long and may be interrupted.
        """
        row = (str(file), stamp, description)
        self.connection.execute("INSERT OR REPLACE INTO recordings VALUES (?, ?, ?)", row)
        self.connection.commit()

    def run_key(self, run: str) -> str:
        """Return the key of the products whose numbers are stored; "" when there are none."""
        row = self.connection.execute("SELECT key FROM runs WHERE run = ?", (run,)).fetchone()
        return row[0] if row else ""

    def store_run(self, head: tuple, measured: Measurements) -> None:
        """Store what was `measured` in a run, and remove the numbers of its earlier products.

        The `head` has its columns of the table `runs` up to the target, the measurements have the others, and
        the rows of `numbers` and `checks`.
        """
        run = head[0]
        for table in ("checks", "numbers", "runs"):
            self.connection.execute(f"DELETE FROM {table} WHERE run = ?", (run,))
        failed, effects = json.dumps(measured.checks_failed), json.dumps(measured.effects)
        self.connection.execute(
            "INSERT INTO runs VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (*head, measured.status, failed, measured.verdict, effects, measured.model, measured.key),
        )
        numbers = [(run, name, *found) for name, found in measured.numbers.items()]
        self.connection.executemany("INSERT INTO numbers VALUES (?, ?, ?, ?)", numbers)
        checks = [
            (run, stage, one.name, one.value, one.unit, one.low, one.high, one.passed, one.message)
            for stage, one in measured.checks
        ]
        self.connection.executemany("INSERT INTO checks VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", checks)

    def failed_calibrations(self, recipes: Iterable[str]) -> dict[str, str]:
        """Return why calibrations failed the check of one of the `recipes`, by ``<night>/<group>``."""
        rows = self.connection.execute(
            "SELECT run, recipe, CASE WHEN json_valid(checks_failed) THEN checks_failed ELSE '[]' END"
            " FROM runs WHERE kind = 'calibration' AND status = 'qc_failed'"
        )
        wanted = set(recipes)
        return {
            run.rpartition("/")[0]: "failed " + ", ".join(map(str, json.loads(checks) or ["?"]))
            for run, recipe, checks in rows
            if recipe in wanted
        }

    def points(self) -> list[Point]:
        """Return the numbers in order of time, but of runs that failed their quality check."""
        rows = self.connection.execute(
            f"SELECT run, night, coalesce(start_unix_s, {MIDNIGHT}), name, recipe,"
            " configuration, value, sigma FROM numbers JOIN runs USING (run)"
            f" WHERE {SOUND} AND {A_NUMBER}"
            " AND status != 'qc_failed' ORDER BY 3, run, name"
        )
        return [Point(*row) for row in rows]

    def reductions(self) -> list[dict[str, Any]]:
        """Return what there is of every run, its numbers by their names, the latest first."""
        head = ("run", "night", "target", "status", "verdict", "passed", "checks")
        rows = self.connection.execute(
            "SELECT run, night, target, status, verdict, sum(passed), count(passed) FROM runs"
            f" LEFT JOIN checks USING (run) WHERE {SOUND} GROUP BY run ORDER BY night DESC, start_unix_s, run"
        )
        found = {row[0]: dict(zip(head, row, strict=True)) for row in rows}
        numbers = self.connection.execute("SELECT run, name, value, sigma FROM numbers WHERE " + A_NUMBER)
        for run, name, *value in numbers:
            found.get(run, {})[name] = value
        return list(found.values())

    def verdicts(self) -> list[Verdict]:
        rows = self.connection.execute(
            "SELECT run, night, target, verdict, effects FROM runs"
            f" WHERE {SOUND} AND verdict IS NOT NULL"
            " AND CASE WHEN json_valid(effects) THEN json_type(effects) = 'array' END"
            " ORDER BY night, start_unix_s, run"
        )
        return [
            Verdict(run, night, target, verdict, tuple(json.loads(effects)))
            for run, night, target, verdict, effects in rows
        ]


@contextmanager
def opened(tree: Path) -> Iterator[Database]:
    """Open the database of a tree, creating it if necessary; the block is one transaction.

    Raises `IrlosError` when the file cannot be read or written, or is not such a database; it is unchanged
    then.
    """
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
                yield Database(connection)
        finally:
            connection.close()
    except sqlite3.Error as error:
        if getattr(error, "sqlite_errorcode", None) in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            raise Locked(f"{path}: in use by another program; close it and run again") from error
        raise IrlosError(
            f"{path}: {error}; the products hold everything in it: move the file away, and the next "
            "irlos night makes it again"
        ) from error


@contextmanager
def copied(tree: Path | None) -> Iterator[Database]:
    """Give a copy in memory of the database of a tree, empty if there is none; nothing is written."""
    connection = sqlite3.connect(":memory:")
    try:
        if tree is not None and (tree / NAME).is_file():
            with opened(tree) as stored:
                stored.connection.backup(connection)
        _require_schema(connection, (tree or Path()) / NAME)
        yield Database(connection)
    finally:
        connection.close()


@contextmanager
def existing(tree: Path) -> Iterator[Database]:
    """Open the database of a tree for reading.

    Raises `InputDataError` when there is none.
    """
    if not (tree / NAME).is_file():
        raise InputDataError(
            f"{tree}: not the tree of irlos night (no {NAME}); make one with: "
            "irlos night NIGHT_DIR --output TREE"
        )
    with opened(tree) as database:
        yield database


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


def write_dashboard(tree: Path, path: Path) -> None:
    """Write a dashboard for Grafana that shows the database of a `tree` to the file `path`.

    Raises `ConfigurationError` when its name does not end in ``.json``.
    """
    if path.suffix != ".json":
        raise ConfigurationError(f"--dashboard {path}: give a name that ends in .json")
    content = {
        "__inputs": [
            {
                "name": "DS_IRLOS", "label": "irlos", "type": "datasource",
                "pluginId": SOURCE["type"], "pluginName": "SQLite",
                "description": f"path of the database: {tree.absolute() / NAME}",
            }
        ],
        "title": "IRLOS", "uid": "irlos-trend", "schemaVersion": 39, "editable": True, "refresh": "15m",
        "time": {"from": "now-90d", "to": "now"}, "timezone": "utc",
        "panels": [_panel(number, *one) for number, one in enumerate([*SERIES, *TABLES])],
    }  # fmt: skip
    write_bytes(path, (json.dumps(content, indent=1) + "\n").encode())


def _panel(number: int, title: str, query: str, unit: str = "") -> dict[str, Any]:
    """Points against time of numbers with a `unit`, else a table."""
    kind, result = ("timeseries", "time series") if unit else ("table", "table")
    place = {"h": HEIGHT, "w": COLUMNS, "x": COLUMNS * (number % 2), "y": HEIGHT * (number // 2)}
    target = {
        "refId": "A", "datasource": SOURCE, "queryType": result, "queryText": query, "rawQueryText": query,
        "timeColumns": ["time"],
    }  # fmt: skip
    panel = {
        "id": number + 1, "title": title, "type": kind, "datasource": SOURCE, "gridPos": place,
        "targets": [target],
    }  # fmt: skip
    drawn = {"defaults": {"unit": unit, "custom": {"drawStyle": "points"}}, "overrides": []}
    return panel | ({"fieldConfig": drawn} if unit else {})
