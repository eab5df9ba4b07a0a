"""The checks of all experiments as a table: how many there are, and which were missed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from irlos_pipe.paper.run.tables import plain_table
from irlos_pipe.product.product import Check

COLUMNS = ("experiment", "kept", "missed")


def table_of_checks(results: Mapping[str, Any]) -> str:
    """Return a table in Markdown: the experiments, how many of their checks were kept, which were missed.

    Parameters
    ----------
    results : mapping
        Content of paper_results.json.
    """
    rows = [_row(name, _checks(experiment)) for name, experiment in results["experiments"].items()]
    return plain_table(COLUMNS, rows)


def _checks(experiment: Mapping[str, Any]) -> list[Check]:
    entries = [entry for of_stage in experiment["checks"].values() for entry in of_stage]
    return [_check(entry) for entry in entries]


def _check(entry: Mapping[str, Any]) -> Check:
    given = {part.name: entry[part.name] for part in fields(Check)}
    return Check(**given | {"value": math.nan if entry["value"] is None else entry["value"]})


def _row(name: str, checks: list[Check]) -> tuple[str, ...]:
    missed = [check for check in checks if not check.passed]
    told = "<br>".join(
        f"{one.name}: {one.value:.3g} {one.unit}".rstrip() + f" ({one.limits})" for one in missed
    )
    return f"`{name}`", f"{len(checks) - len(missed)} of {len(checks)}", told or "–"
