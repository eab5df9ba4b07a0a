"""Renew the tables of docs/results.md: ``python -m irlos_pipe.paper.run.results_page``.

The numbers are those of docs/paper, where ``--take`` puts those of a run. A table that an experiment lists
with ``page`` stands between ``<!-- paper:NAME -->`` and ``<!-- /paper -->``, those of the states of the code
and of the checks under the names ``code`` and ``checks``; the text around the tables is kept.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.atomic import write_if_changed
from irlos_pipe.paper.common.table import csv_text, markdown, read_csv, read_tables
from irlos_pipe.paper.run.run import CHECKS, RUNS
from irlos_pipe.product.product import Check
from irlos_pipe.stages import EXPERIMENTS, STAGES

PAGE, NUMBERS = Path("docs/results.md"), Path("docs/paper")
BLOCK = re.compile(r"(<!-- paper:(\S+) -->\n).*?(<!-- /paper -->)", re.DOTALL)
CsvRows = Sequence[Mapping[str, str]]


def with_tables(text: str, tables: Mapping[str, str]) -> str:
    """Return the `text` of a page with every one of the `tables`, in Markdown by name, renewed.

    Raises `ConfigurationError` if there is no table for a mark, or no mark for a table.
    """
    named = {found[2] for found in BLOCK.finditer(text)}
    for name in named - tables.keys():
        raise ConfigurationError(f"<!-- paper:{name} -->: no such table{suggestion(name, tables)}")
    for name in tables.keys() - named:
        raise ConfigurationError(f"table '{name}': no <!-- paper:{name} --> in the text")
    return BLOCK.sub(lambda found: f"{found[1]}{tables[found[2]]}\n{found[3]}", text)


def renewed(root: Path) -> str:
    """Return docs/results.md of a source tree with its tables made from the numbers there."""
    runs, checks = (read_csv(root / NUMBERS / name) for name in (RUNS, CHECKS))
    tables = {"code": table_of_states(runs), "checks": table_of_checks(checks)}
    for run in runs:
        found = read_tables(root / NUMBERS / f"{run['experiment']}.csv")
        for listing in getattr(STAGES[run["stage"]], "listings", ()):
            if listing.page:
                tables[listing.page] = listing.markdown(found)
    return with_tables((root / PAGE).read_text(encoding="utf-8"), tables)


def table_of_states(runs: CsvRows) -> str:
    """Return a table of the states of the code, the days of their last experiments, and which these are."""
    rows = [
        (code, max(run["finished"][:10] for run in own), ", ".join(f"`{run['experiment']}`" for run in own))
        for code, own in _by_code(runs).items()
    ]
    return markdown(("code", "finished", "experiments"), ["---"] * 3, rows)


def table_of_checks(checks: CsvRows) -> str:
    """Return a table of the experiments, how many of their checks were kept, which were missed."""
    rows = []
    for name, group in groupby(checks, lambda row: row["experiment"]):
        own = []
        for row in group:
            low, high = (float(row[end]) if row[end] else None for end in ("low", "high"))
            value = float(row["value"] or math.nan)
            own.append(Check(row["name"], value, row["unit"], low, high, row["message"]))
        missed = [one for one in own if not one.passed]
        named = [f"{one.name}: {one.value:.3g} {one.unit}".rstrip() + f" ({one.limits})" for one in missed]
        rows.append((f"`{name}`", f"{len(own) - len(missed)} of {len(own)}", "<br>".join(named) or "–"))
    return markdown(("experiment", "kept", "missed"), ["---"] * 3, rows)


def _by_code(runs: CsvRows) -> dict[str, list[Mapping[str, str]]]:
    states: dict[str, list[Mapping[str, str]]] = {}
    for run in runs:
        states.setdefault(run["code"], []).append(run)
    return states


def take(root: Path, source: Path, others_stay: bool) -> None:
    """Make the numbers of a run of `irlos paper`, in the folder `source`, those of the source tree `root`.

    With `others_stay`, its experiments join those that are there, which may be of other states of the
    code.

    Raises `ConfigurationError` if samples are small, experiments are missing, or of several states of the
    code.
    """
    new: dict[str, CsvRows] = {name: read_csv(source / name) for name in (RUNS, CHECKS)}
    taken = {run["experiment"] for run in new[RUNS]}
    states = _by_code(new[RUNS])
    if any(run["quick"] != "False" for run in new[RUNS]):
        raise ConfigurationError(f"{source} has small samples (--quick)")
    if others_stay:
        old = {name: read_csv(root / NUMBERS / name) for name in new}
        place = {run["experiment"]: EXPERIMENTS.index(run["stage"]) for run in [*old[RUNS], *new[RUNS]]}
        for name, rows in new.items():
            kept = [row for row in old[name] if row["experiment"] not in taken]
            new[name] = sorted([*rows, *kept], key=lambda row: place[row["experiment"]])
    elif len(states) > 1:
        each = "; ".join(
            f"{code}: {', '.join(one['experiment'] for one in own)}" for code, own in states.items()
        )
        raise ConfigurationError(
            f"experiments of {len(states)} states of the code ({each}); repeat them with one, in a new "
            "folder, or give --beside to put them beside those of other states, which the page then tells"
        )
    missing = set(EXPERIMENTS) - {run["stage"] for run in new[RUNS]}
    if missing:
        raise ConfigurationError(f"{source} has no {', '.join(sorted(missing))}")
    for name in taken:
        write_if_changed(root / NUMBERS / f"{name}.csv", (source / f"{name}.csv").read_bytes())
    for name, rows in new.items():
        write_if_changed(root / NUMBERS / name, csv_text(rows).encode())


def main() -> None:
    """Renew the tables of docs/results.md in a source tree."""
    parser = argparse.ArgumentParser(
        prog="python -m irlos_pipe.paper.run.results_page", description=main.__doc__
    )
    parser.add_argument("root", nargs="?", default=".", type=Path, help="the source tree (default: here)")
    parser.add_argument(
        "--take", type=Path, metavar="DIR", help="folder of the numbers of a run, to be shown"
    )
    parser.add_argument("--beside", action="store_true", help="keep experiments that DIR does not have")
    given = parser.parse_args()
    root = given.root
    try:
        if given.take is not None:
            take(root, given.take, given.beside)
        changed = write_if_changed(root / PAGE, renewed(root).encode())
    except (IrlosError, OSError) as error:
        raise SystemExit(f"irlos: error: {error}") from None
    print(f"{root / PAGE}: {'renewed' if changed else 'unchanged'}")


if __name__ == "__main__":
    main()
