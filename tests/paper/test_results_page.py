"""The tables of docs/results.md. Truth: pages and tables written by hand, and the recipes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.paths import REPOSITORY

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.files.json import jsonable
from irlos_pipe.paper.common.table import csv_text, read_csv, read_tables
from irlos_pipe.paper.run.recipes import find_experiments
from irlos_pipe.paper.run.results_page import NUMBERS, PAGE, renewed, table_of_checks, take, with_tables
from irlos_pipe.paper.run.run import CHECKS, RUNS
from irlos_pipe.stages import EXPERIMENTS, STAGES

COMMITTED = REPOSITORY / NUMBERS


def test_only_the_tables_of_a_page_are_replaced():
    text = "a\n<!-- paper:one -->\nold\n<!-- /paper -->\nb\n"
    assert with_tables(text, {"one": "| new |"}) == "a\n<!-- paper:one -->\n| new |\n<!-- /paper -->\nb\n"
    with pytest.raises(ConfigurationError, match="<!-- paper:one -->: no such table; did you mean 'ones'"):
        with_tables(text, {"ones": ""})
    with pytest.raises(ConfigurationError, match="table 'two': no <!-- paper:two --> in the text"):
        with_tables(text, {"one": "", "two": ""})


def test_the_table_counts_the_checks_and_names_those_that_were_missed():
    columns = ("experiment", "message", "name", "value", "unit", "low", "high")
    limits = [
        ("slope", "1.0", "", "0.97", "1.03"),
        ("error", "4.56", "nm", "", "4"),
        ("limit", "", "mag", "0", ""),
    ]
    rows = [dict(zip(columns, ("ramp", "", *one), strict=True)) for one in limits]
    assert table_of_checks(rows).splitlines()[2:] == [
        "| `ramp` | 1 of 3 | error: 4.56 nm (≤ 4)<br>limit: nan mag (≥ 0) |"
    ]


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


ALL = dict.fromkeys(EXPERIMENTS, "1.0")


def test_a_run_of_one_state_of_the_code_is_taken_and_one_of_two_is_not(tmp_path):
    root = numbers(tmp_path / NUMBERS, **ALL).parents[1]
    take(root, numbers(tmp_path / "new", **dict.fromkeys(ALL, "1.1")), others_stay=False)
    assert {run["code"] for run in read_csv(root / NUMBERS / RUNS)} == {"1.1"}
    assert (root / NUMBERS / "faint.csv").read_text() == "1.1"
    with pytest.raises(ConfigurationError, match=r"2 states of the code \(1\.0: .*; 1\.2: faint\)"):
        take(root, numbers(tmp_path / "two", **{**ALL, "faint": "1.2"}), others_stay=False)


def test_beside_others_only_its_own_experiments_are_replaced(tmp_path):
    root = numbers(tmp_path / NUMBERS, **ALL).parents[1]
    take(root, numbers(tmp_path / "new", faint="1.2"), others_stay=True)
    found = read_csv(root / NUMBERS / RUNS)
    assert [run["stage"] for run in found] == list(EXPERIMENTS)
    assert {run["stage"]: run["code"] for run in found if run["code"] != "1.0"} == {"faint": "1.2"}
    assert [check["name"] for check in read_csv(root / NUMBERS / CHECKS)].count("1.2") == 1


@pytest.mark.parametrize(
    ("quick", "code", "others_stay", "message"),
    [
        (False, {"methods": "1.0"}, False, "has no capture, "),
        (True, ALL, False, "has small samples"),
        (True, {"faint": "1.0"}, True, "has small samples"),
    ],
)
def test_a_run_that_lacks_experiments_or_is_a_quick_look_is_not_taken(
    tmp_path, quick, code, others_stay, message
):
    root = numbers(tmp_path / NUMBERS, **ALL).parents[1]
    with pytest.raises(ConfigurationError, match=message):
        take(root, numbers(tmp_path / "new", quick, **code), others_stay)


@pytest.mark.slow
def test_the_command_renews_the_page_of_a_source_tree_and_reports_a_mistake_in_one_line(tmp_path):
    def renew() -> subprocess.CompletedProcess:
        command = [sys.executable, "-m", "irlos_pipe.paper.run.results_page", str(tmp_path)]
        return subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY)

    (tmp_path / "docs").mkdir()
    (tmp_path / NUMBERS).symlink_to(COMMITTED)
    text = (REPOSITORY / PAGE).read_text(encoding="utf-8")
    (tmp_path / PAGE).write_text(text.replace("| `low_wind` | 12 of 12 |", "| old |"), encoding="utf-8")
    assert renew().stdout.endswith("docs/results.md: renewed\n")
    assert (tmp_path / PAGE).read_text(encoding="utf-8") == text
    (tmp_path / PAGE).write_text(text.replace("paper:exposures", "paper:exposure"), encoding="utf-8")
    failed = renew()
    assert failed.returncode == 1 and failed.stderr.startswith("irlos: error: ")
    assert len(failed.stderr.splitlines()) == 1


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
