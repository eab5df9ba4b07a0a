"""The tables of docs/results.md. Truth: pages and tables written by hand, and the recipes."""

import json

import pytest
from helpers.paths import REPOSITORY

from irlos_pipe.files.json import jsonable
from irlos_pipe.paper.common.table import read_csv
from irlos_pipe.paper.run.run import CHECKS, RUNS, find_experiments
from irlos_pipe.stages import STAGES
from maintenance.paper_tables import NUMBERS, PAGE, read_tables, tables

COMMITTED = REPOSITORY / NUMBERS


def test_the_committed_numbers_are_those_of_the_full_recipes_as_they_are_now():
    found = read_csv(COMMITTED / RUNS)
    known = find_experiments(REPOSITORY / "recipes/paper")
    assert [run["experiment"] for run in found] == [one.name for one in known]
    for run, one in zip(found, known, strict=True):
        sizes = jsonable(one.recipe.configs[run["stage"]])
        assert (run["quick"], int(run["seed"]), json.loads(run["sizes"])) == ("False", one.recipe.seed, sizes)


def test_the_page_agrees_with_the_committed_numbers():
    page = (REPOSITORY / PAGE).read_text(encoding="utf-8")
    for name, text in tables(REPOSITORY).items():
        assert f"<!-- {name} -->\n\n{text}\n\n<!-- /{name} -->" in page, "run: make paper-tables"


@pytest.mark.parametrize("run", read_csv(COMMITTED / RUNS), ids=lambda run: run["stage"])
def test_the_committed_checks_are_those_of_the_numbers_and_listings_name_their_columns(run):
    experiment, results = STAGES[run["stage"]], read_tables(COMMITTED / f"{run['experiment']}.csv")
    stored = [row for row in read_csv(COMMITTED / CHECKS) if row["experiment"] == run["experiment"]]
    found = experiment.checks(results)
    assert [(check.name, check.message) for check in found] == [
        (row["name"], row["message"]) for row in stored
    ]
    values = [float(row["value"]) for row in stored]
    assert [check.value for check in found] == pytest.approx(values, rel=1e-12)
    for listing in experiment.listings:
        patterns = [*listing.cells.values(), *listing.across, *listing.across.values(), listing.caption]
        columns = {part.split(":")[0].split("}")[0] for text in patterns for part in text.split("{")[1:]}
        assert columns <= set(results[listing.of].columns)
        assert listing.table(results).rows
