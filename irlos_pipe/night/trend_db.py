"""The numbers of all nights: one row per run, put in anew whenever the run was."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import dataclass

from irlos_pipe.night.grouping import Group
from irlos_pipe.night.measures import Measured

# Of a night without times: local midnight of Paranal, which comes after that of its date.
MIDNIGHT = "CAST(strftime('%s', night, '+1 day', '+282 minutes') AS REAL)"


@dataclass(frozen=True)
class Point:
    """One number of one run.

    Attributes
    ----------
    unix_s : float
        Begin of the recording [s since 1970]; the middle of the night where it is not known.
    sigma : float or None
        1-sigma error.
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
    """What `diagnose` said of a recording."""

    run: str
    night: str
    target: str
    verdict: str
    effects: tuple[str, ...]

    @property
    def group(self) -> str:
        """Name of the group in its night."""
        return self.run.split("/")[1]


def stored_key(connection: sqlite3.Connection, run: str) -> str:
    """Return the key of the products whose numbers are stored; nothing when there are none."""
    row = connection.execute("SELECT key FROM runs WHERE run = ?", (run,)).fetchone()
    return row[0] if row else ""


def store(connection: sqlite3.Connection, run: str, group: Group, recipe: str, measured: Measured) -> None:
    """Put in the numbers of a run, in place of those it had before."""
    first = group.first
    connection.execute("DELETE FROM runs WHERE run = ?", (run,))  # its numbers go with it
    connection.execute(
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
    connection.executemany("INSERT INTO numbers VALUES (?, ?, ?, ?)", rows)


def points(connection: sqlite3.Connection, until: str = "") -> list[Point]:
    """Return all numbers in order of time.

    Parameters
    ----------
    until : str
        Last night to return, ISO date; all if empty.
    """
    rows = connection.execute(
        f"SELECT run, night, coalesce(start_unix_s, {MIDNIGHT}), name, recipe,"
        " configuration, value, sigma FROM numbers JOIN runs USING (run) ORDER BY 3, run, name"
    )
    return [one for one in (Point(*row) for row in rows) if not until or one.night <= until]


def verdicts(connection: sqlite3.Connection, until: str = "") -> list[Verdict]:
    """Return what `diagnose` said, in order of time."""
    rows = connection.execute(
        "SELECT run, night, target, verdict, effects FROM runs"
        " WHERE verdict IS NOT NULL ORDER BY night, start_unix_s, run"
    )
    found = (
        Verdict(run, night, target, verdict, tuple(json.loads(effects)))
        for run, night, target, verdict, effects in rows
    )
    return [one for one in found if not until or one.night <= until]
