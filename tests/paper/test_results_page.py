"""The tables of docs/results.md. Truth: pages and tables written by hand, and the recipes."""

import json
from pathlib import Path

import pytest
from helpers.paths import REPOSITORY

from irlos_pipe.files.json import jsonable
from irlos_pipe.paper.common.table import csv_text, read_csv, read_tables
from irlos_pipe.paper.run.results_page import NUMBERS, PAGE, renewed
from irlos_pipe.paper.run.run import CHECKS, RUNS, find_experiments
from irlos_pipe.stages import STAGES

COMMITTED = REPOSITORY / NUMBERS


def numbers(folder: Path, quick: bool = False, **code: str) -> Path:
    """Numbers of the stages given, each with its state of the code."""
    folder.mkdir(parents=True, exist_ok=True)
    rest = {"quick": str(quick), "finished": "2026-11-22T03:00:00+00:00"}
    runs = [{"experiment": name, "stage": name, "code": one, **rest} for name, one in code.items()]
    (folder / RUNS).write_text(csv_text(runs))
    (folder / CHECKS).write_text(csv_text([{"experiment": name, "name": one} for name, one in code.items()]))
    for name, one in code.items():
        (folder / f"{name}.csv").write_text(one)
    return folder


# -- the committed numbers ---------------------------------------------------------------------------


def test_the_committed_numbers_are_those_of_the_full_recipes_as_they_are_now():
    found = read_csv(COMMITTED / RUNS)
    known = find_experiments(REPOSITORY / "recipes/paper")
    assert [run["experiment"] for run in found] == [one.name for one in known]
    for run, one in zip(found, known, strict=True):
        sizes = jsonable(one.recipe.configs[run["stage"]])
        assert (run["quick"], int(run["seed"]), json.loads(run["sizes"])) == ("False", one.recipe.seed, sizes)


def test_the_page_agrees_with_the_committed_numbers():
    assert (REPOSITORY / PAGE).read_text(encoding="utf-8") == renewed(REPOSITORY), "run: make paper-tables"


@pytest.mark.parametrize("run", read_csv(COMMITTED / RUNS), ids=lambda run: run["stage"])
def test_the_committed_checks_are_those_of_the_numbers_and_listings_name_their_columns(run):
    experiment, tables = STAGES[run["stage"]], read_tables(COMMITTED / f"{run['experiment']}.csv")
    stored = [row for row in read_csv(COMMITTED / CHECKS) if row["experiment"] == run["experiment"]]
    found = experiment.checks(tables)
    assert [(check.name, check.message) for check in found] == [
        (row["name"], row["message"]) for row in stored
    ]
    values = [float(row["value"]) for row in stored]
    assert [check.value for check in found] == pytest.approx(values, rel=1e-12)
    for listing in experiment.listings:
        patterns = [*listing.cells.values(), *listing.across, *listing.across.values(), listing.caption]
        columns = {part.split(":")[0].split("}")[0] for text in patterns for part in text.split("{")[1:]}
        assert columns <= set(tables[listing.of].columns)
        assert listing.table(tables).rows
