"""Descriptions of recordings met before: an archive is read once, afterwards only what is new in it."""

from __future__ import annotations

import json
import sqlite3
from dataclasses import asdict
from pathlib import Path

from irlos_pipe.files.json import json_text
from irlos_pipe.night.description import Description


class Catalogue:
    """Descriptions by file, in the database of a tree."""

    def __init__(self, connection: sqlite3.Connection):
        self._connection = connection

    def known(self, file: Path, stamp: str) -> Description | None:
        """Return the description of a file that is as it was; None when it is new or changed."""
        query = "SELECT description FROM recordings WHERE file = ? AND stamp = ?"
        row = self._connection.execute(query, (str(file), stamp)).fetchone()
        if row is None:
            return None
        return _description(row[0])

    def still_there(self) -> list[Description]:
        """Return what is known of recordings of all nights whose files are there."""
        rows = self._connection.execute("SELECT file, description FROM recordings ORDER BY file")
        return [_description(text) for file, text in rows if Path(file).is_file()]

    def remember(self, file: Path, stamp: str, description: Description) -> None:
        """Keep a description, for good at once: reading an archive takes long and may be interrupted."""
        self._connection.execute(
            "INSERT OR REPLACE INTO recordings VALUES (?, ?, ?)",
            (str(file), stamp, json_text(asdict(description), None)),
        )
        self._connection.commit()


def _description(text: str) -> Description:
    values = json.loads(text)
    return Description(**values | {"path": Path(values["path"]), "window": tuple(values["window"])})
