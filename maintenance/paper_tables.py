"""Renew the tables of docs/results.md: ``python -m maintenance.paper_tables``.

The numbers are those of docs/paper, where ``--take`` puts those of a run. A table that an experiment lists
with ``page`` stands between ``<!-- paper:NAME -->`` and ``<!-- /paper:NAME -->``, what came of the checks
under the name ``checks``; the text around the tables is kept.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

import pandas as pd

from benchmarks.harness import markdown, put
from irlos_pipe.paper.run.run import CHECKS, RUNS
from irlos_pipe.product.product import Check
from irlos_pipe.stages import EXPERIMENTS, STAGES

PAGE, NUMBERS = Path("docs/results.md"), Path("docs/paper")


def read(text: Path | io.StringIO, **types: type) -> pd.DataFrame:
    """Return a CSV with all digits of its numbers; only what is empty is missing."""
    return pd.read_csv(text, keep_default_na=False, na_values=[""], **types)


def read_tables(path: Path) -> dict[str, pd.DataFrame]:
    """Return the tables of an experiment by name, each with its columns in types of their own."""
    every = read(path, dtype=str)
    own = {name: rows.drop(columns="table") for name, rows in every.groupby("table", sort=False)}
    return {name: read(io.StringIO(rows.to_csv(index=False))) for name, rows in own.items()}


def tables(root: Path) -> dict[str, str]:
    """Return the tables of the page in Markdown by name, from the numbers of a source tree."""
    runs, checks = (read(root / NUMBERS / name) for name in (RUNS, CHECKS))
    found = {"checks": table_of_checks(checks)}
    for run in runs.itertuples():
        for listing in getattr(STAGES[run.stage], "listings", ()):
            if listing.page:
                shown = listing.table(read_tables(root / NUMBERS / f"{run.experiment}.csv"), ranges=False)
                sides = "l" + "r" * (len(shown.columns) - 1)
                text = markdown(shown.columns, shown.rows, sides)
                found[listing.page] = "\n\n".join(filter(None, (text, shown.caption)))
    return {f"paper:{name}": text for name, text in found.items()}


def table_of_checks(checks: pd.DataFrame) -> str:
    """Return how many checks of the experiments were kept, and a table of those that were missed."""
    rows = []
    for one in checks.fillna({"unit": ""}).itertuples():
        limits = (None if pd.isna(limit) else limit for limit in (one.low, one.high))
        check = Check(one.name, one.value, one.unit, *limits, "")
        if not check.passed:
            value = f"{one.value:.3g} {one.unit}".rstrip()
            rows.append((f"`{one.experiment}`", one.name, value, check.limits))
    kept = f"{len(checks) - len(rows)} of {len(checks)} checks are kept."
    return f"{kept}\n\n{markdown(('experiment', 'missed check', 'value', 'limit'), rows, 'llrr')}"


def take(root: Path, source: Path, others_stay: bool) -> None:
    """Make the numbers of a run of `irlos paper`, in the folder `source`, those of the source tree `root`.

    With `others_stay`, its experiments join those that are there, which may be of other states of the code.
    """
    new = {name: read(source / name, dtype=str) for name in (RUNS, CHECKS)}
    taken = set(new[RUNS].experiment)
    if (new[RUNS].quick != "False").any():
        raise SystemExit(f"{source} has small samples (--quick)")
    if not others_stay and new[RUNS].code.nunique() > 1:
        raise SystemExit(
            f"{source}: experiments of {new[RUNS].code.nunique()} states of the code; repeat them with one, "
            "in a new folder, or give --beside, which adds them to those of others, as runs.csv says then"
        )
    if others_stay:
        for name, rows in new.items():
            old = read(root / NUMBERS / name, dtype=str)
            new[name] = pd.concat([rows, old[~old.experiment.isin(taken)]])
        stage = new[RUNS].set_index("experiment").stage
        for name, rows in new.items():
            places = rows.experiment.map(stage).map(EXPERIMENTS.index)
            new[name] = rows.iloc[places.argsort(kind="stable")]
    if missing := set(EXPERIMENTS) - set(new[RUNS].stage):
        raise SystemExit(f"{source} has no {', '.join(sorted(missing))}")
    for name in taken:
        (root / NUMBERS / f"{name}.csv").write_bytes((source / f"{name}.csv").read_bytes())
    for name, rows in new.items():
        rows.to_csv(root / NUMBERS / name, index=False, lineterminator="\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--take", type=Path, metavar="DIR", help="folder of the numbers of a run, to be shown"
    )
    parser.add_argument("--beside", action="store_true", help="keep experiments that DIR does not have")
    given = parser.parse_args()
    if given.take is not None:
        take(Path(), given.take, given.beside)
    put(PAGE, tables(Path()))
