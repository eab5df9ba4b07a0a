"""A dashboard for Grafana that shows the database of a tree."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.night.database import NAME

SOURCE = {"type": "frser-sqlite-datasource", "uid": "${DS_IRLOS}"}
WINDOW = "coalesce(start_unix_s, strftime('%s', night)) BETWEEN $__from / 1000 AND $__to / 1000"
COLUMNS, HEIGHT = 12, 8  # of a panel; the page has 24 columns
SERIES = (
    ("NCPAs, Noll 4 to 11", "lengthnm", [f"noll_{noll}_nm" for noll in range(4, 12)]),
    ("RMS of the NCPAs", "lengthnm", ["ncpa_nm"]),
    ("Defocus bias of ramps", "lengthnm", ["defocus_bias_nm"]),
    ("Slope of ramps", "none", ["ramp_slope"]),
    ("Seeing", "arcsec", ["seeing_arcsec"]),
    ("Gap before and after diagnosis", "none", ["gap_before", "gap_after", "gap_floor"]),
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


def dashboard(tree: Path) -> dict[str, Any]:
    """Return the dashboard of a `tree` in Grafana's format, for its SQLite data source."""
    return {
        "__inputs": [
            {
                "name": "DS_IRLOS", "label": "irlos", "type": "datasource",
                "pluginId": SOURCE["type"], "pluginName": "SQLite",
                "description": f"path of the database: {tree.absolute() / NAME}",
            }
        ],
        "title": "IRLOS", "uid": "irlos-trend", "schemaVersion": 39, "editable": True, "refresh": "15m",
        "time": {"from": "now-90d", "to": "now"}, "timezone": "utc",
        "panels": list(_panels()),
    }  # fmt: skip


def write_dashboard(tree: Path, path: Path) -> None:
    """Write the dashboard of a `tree` to the file `path`.

    Raises
    ------
    ConfigurationError
        When its name does not end in ``.json``.
    """
    if path.suffix != ".json":
        raise ConfigurationError(f"--dashboard {path}: give a name that ends in .json")
    write_bytes(path, (json.dumps(dashboard(tree), indent=1) + "\n").encode())


def _panels() -> Iterator[dict[str, Any]]:
    for number, (title, unit, names) in enumerate(SERIES):
        yield _panel(number, title, "timeseries", _points(names), "time series") | {
            "fieldConfig": {"defaults": {"unit": unit, "custom": {"drawStyle": "points"}}, "overrides": []}
        }
    for number, (title, query) in enumerate(TABLES, len(SERIES)):
        yield _panel(number, title, "table", query, "table")


def _points(names: list[str]) -> str:
    """Values of numbers against time; every number is a line of its own."""
    listed = ", ".join(f"'{name}'" for name in names)
    return (
        "SELECT CAST(coalesce(start_unix_s, strftime('%s', night)) AS INTEGER) AS time, "
        "name || ' ' || recipe AS metric, value FROM numbers JOIN runs USING (run) "
        f"WHERE name IN ({listed}) AND status != 'qc_failed' AND {WINDOW} ORDER BY time"
    )


def _panel(number: int, title: str, kind: str, query: str, result: str) -> dict[str, Any]:
    place = {"h": HEIGHT, "w": COLUMNS, "x": COLUMNS * (number % 2), "y": HEIGHT * (number // 2)}
    target = {
        "refId": "A", "datasource": SOURCE, "queryType": result, "queryText": query, "rawQueryText": query,
        "timeColumns": ["time"],
    }  # fmt: skip
    return {
        "id": number + 1, "title": title, "type": kind, "datasource": SOURCE, "gridPos": place,
        "targets": [target],
    }  # fmt: skip
