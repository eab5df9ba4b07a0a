"""The SQLite file of a tree: descriptions of recordings, and the numbers of all nights."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from irlos_pipe.conventions.errors import InputDataError, IrlosError

NAME = "trend.sqlite"
SCHEMA_VERSION = 1
SCHEMA = """
CREATE TABLE IF NOT EXISTS recordings (
    file TEXT PRIMARY KEY,      -- absolute path of the data file
    stamp TEXT NOT NULL,        -- its size and time, those of its side-car
    description TEXT NOT NULL   -- JSON
);
CREATE TABLE IF NOT EXISTS runs (
    run TEXT PRIMARY KEY,       -- <night>/<group>/<recipe>
    night TEXT NOT NULL,        -- date of the evening, ISO
    kind TEXT NOT NULL,         -- calibration, ramp, derotator, psf
    recipe TEXT NOT NULL,
    start_unix_s REAL,          -- begin of the first recording
    configuration TEXT NOT NULL,
    target TEXT NOT NULL,
    status TEXT NOT NULL,       -- ok, qc_failed, partial
    checks_failed TEXT NOT NULL,-- JSON list
    verdict TEXT,               -- of diagnose: none, effect, unknown
    effects TEXT NOT NULL,      -- JSON list of the names found by diagnose
    model TEXT NOT NULL,        -- versions of software and stages
    key TEXT NOT NULL           -- of the last product: all that it depends on
);
CREATE TABLE IF NOT EXISTS numbers (
    run TEXT NOT NULL REFERENCES runs(run) ON DELETE CASCADE,
    name TEXT NOT NULL,         -- noll_4_nm, defocus_bias_nm, seeing_arcsec, gap_before ...
    value REAL NOT NULL,
    sigma REAL,
    PRIMARY KEY (run, name)
);
CREATE INDEX IF NOT EXISTS numbers_by_name ON numbers (name);
"""


@contextmanager
def opened(tree: Path) -> Iterator[sqlite3.Connection]:
    """Open the database of a tree, which is made if need be; the block is one transaction.

    Raises
    ------
    IrlosError
        When it cannot be read or written, or is not what it should be; nothing is changed then.
    """
    path = tree / NAME
    try:
        connection = sqlite3.connect(path, timeout=30)
        try:
            _require_own(connection, path)
            connection.execute("PRAGMA foreign_keys = ON")
            with connection:
                yield connection
        finally:
            connection.close()
    except sqlite3.Error as error:
        raise IrlosError(
            f"{path}: {error}; the products hold all of it: move the file away and run irlos "
            "night again to have it made anew"
        ) from error


@contextmanager
def copied(tree: Path) -> Iterator[sqlite3.Connection]:
    """Give a copy in memory of the database of a tree, an empty one if there is none; nothing is written."""
    connection = sqlite3.connect(":memory:")
    try:
        if (tree / NAME).is_file():
            with opened(tree) as stored:
                stored.backup(connection)
        _require_own(connection, tree / NAME)
        yield connection
    finally:
        connection.close()


@contextmanager
def existing(tree: Path) -> Iterator[sqlite3.Connection]:
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
    with opened(tree) as connection:
        yield connection


def _require_own(connection: sqlite3.Connection, path: Path) -> None:
    version = connection.execute("PRAGMA user_version").fetchone()[0]
    if version > SCHEMA_VERSION:
        raise IrlosError(f"{path}: written by a newer irlos_pipe (schema {version}); use that one")
    if version < SCHEMA_VERSION:
        connection.executescript(SCHEMA)
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
