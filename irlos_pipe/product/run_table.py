"""Checks and numbers of a run as one table, in CSV or SQLite."""

from __future__ import annotations

import csv
import io
import json
import math
import re
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.regular import read_regular
from irlos_pipe.product.results import read_run_results
from irlos_pipe.product.runfolder import RunFolder, existing_run

CHECK_COLUMNS = ("stage", "name", "value", "unit", "low", "high", "passed", "message")
NUMBER_COLUMNS = ("stage", "name", "value", "unit")
KINDS = ("check", "number")
UNIT = re.compile(r"(?:^|[._])(nm2|nm|mas_per_um|mas|arcsec|e2|e|adu|deg|px|hz|m|s|mag)(?=$|\.)")
Row = tuple[Any, ...]


def write_run_table(folder: Path, path: Path, *, replace: bool = False) -> None:
    """Write every check and every number of a run to a ``.csv`` or ``.sqlite`` file.

    CSV has one table whose first column says ``check`` or ``number``; SQLite has the tables ``checks`` and
    ``numbers``. A number is named as in results.json, ``zernike_nm.4`` in stage ``calibrate``.

    Parameters
    ----------
    folder : Path
        The folder of the run.
    path : Path
        The file; its suffix is the format.
    replace : bool
        Whether an existing file is replaced.

    Raises
    ------
    ConfigurationError
        When the file type is unknown, or the file exists and `replace` is False.
    InputDataError
        When it is not the folder of a run, or its files cannot be read.
    """
    writers = {".csv": _csv, ".sqlite": _sqlite}
    if path.suffix not in writers:
        raise ConfigurationError(f"{path}: unknown file type '{path.suffix}'; use .csv or .sqlite")
    if path.exists() and not replace:
        raise ConfigurationError(f"{path}: exists already; choose another name or give --force")
    run = existing_run(folder)
    checks = [tuple(check.values()) for check in read_checks(run)]
    numbers = [
        (stage, name, value, unit_of(name))
        for stage, tree in read_run_results(run.results).stages.items()
        for name, value in _numbers(tree)
    ]
    write_bytes(path, writers[path.suffix](checks, numbers))


def read_checks(run: RunFolder) -> list[dict[str, Any]]:
    """Return the checks of a `run` as they stand in qc.json.

    Raises
    ------
    InputDataError
        When it cannot be read.
    """
    try:
        checks = json.loads(read_regular(run.quality))["checks"]
        return [{column: check[column] for column in CHECK_COLUMNS} for check in checks]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputDataError(f"{run.quality}: cannot be read ({error}); run the recipe again") from error


def _numbers(tree: Any, above: str = "") -> Iterator[tuple[str, float]]:
    """All numbers of a tree with their path; switches are no numbers."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from _numbers(value, f"{above}.{key}" if above else str(key))
    elif isinstance(tree, list):
        for index, value in enumerate(tree):
            yield from _numbers(value, f"{above}.{index}")
    elif isinstance(tree, (int, float)) and not isinstance(tree, bool) and math.isfinite(tree):
        yield above, tree


def unit_of(name: str) -> str:
    """Return the unit that the last part of a `name` with one ends in; "" without."""
    found = UNIT.findall(name)
    return found[-1].replace("_per_", "/") if found else ""


def _csv(checks: list[Row], numbers: list[Row]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("kind", *CHECK_COLUMNS))
    writer.writerows((KINDS[0], *row[:6], int(row[6]), row[7]) for row in checks)
    writer.writerows((KINDS[1], *row, "", "", "", "") for row in numbers)
    return text.getvalue().encode()


def _sqlite(checks: list[Row], numbers: list[Row]) -> bytes:
    connection = sqlite3.connect(":memory:")
    try:
        for name, columns, rows in (("checks", CHECK_COLUMNS, checks), ("numbers", NUMBER_COLUMNS, numbers)):
            connection.execute(f"CREATE TABLE {name} ({', '.join(columns)})")
            places = ", ".join("?" * len(columns))
            connection.executemany(f"INSERT INTO {name} VALUES ({places})", rows)
        connection.commit()
        return connection.serialize()
    finally:
        connection.close()
