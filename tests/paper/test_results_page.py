"""The tables of docs/results.md come from the committed numbers; expected Markdown is written by hand."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.paths import REPOSITORY

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.files.json import jsonable
from irlos_pipe.paper.run.recipes import find_experiments
from irlos_pipe.paper.run.results_page import (
    PAGE,
    RESULTS,
    read_layouts,
    rendered,
    renewed,
    take,
    with_tables,
)
from irlos_pipe.paper.run.states import states_of
from irlos_pipe.paper.run.tables import TableLayout, cell, find, render_table

EXPERIMENTS = {
    "methods": {
        "seed": 5,
        "checks": {},
        "sizes": {"methods": {"samples": 20}},
        "results": {
            "methods": {
                "conditions": [
                    {"seeing_arcsec": 0.35, "shape": "a", "median_nm": {"dip": 41.26, "own": 2.0}},
                    {"seeing_arcsec": 1.0, "shape": "a", "median_nm": {"dip": 60.0, "own": None}},
                    {"seeing_arcsec": 1.0, "shape": "b", "median_nm": {"dip": 70.0, "own": 3.0}},
                ]
            }
        },
    }
}
ROWS = TableLayout(
    **{
        "from": "methods/results/methods/conditions",
        "columns": ["method", "0.35", "1.0"],
        "rows": [
            ["DIP", "{0/median_nm/dip:.1f}", "{1/median_nm/dip:.0f}"],
            ["own", "**{0/median_nm/own:.1f}**", "{1/median_nm/own:.1f}"],
        ],
    }
)


def layout(**changes) -> TableLayout:
    return TableLayout(**{"columns": ["a"], **changes})


def test_rows_show_numbers_in_their_format_and_null_as_a_dash():
    assert render_table(ROWS, EXPERIMENTS) == (
        "| method | 0.35 | 1.0 |\n| --- | ---: | ---: |\n| DIP | 41.3 | 60 |\n| own | **2.0** | – |"
    )


def test_a_list_gives_a_row_for_each_member_and_a_note_stands_below():
    table = layout(
        **{
            "from": "methods",
            "columns": ["seeing", "DIP"],
            "each": "results/methods/conditions",
            "row": ['{seeing_arcsec:.2f}"', "{median_nm/dip:.0f} nm"],
            "note": "{sizes/methods/samples} cubes, seed {seed}.",
        }
    )
    assert render_table(table, EXPERIMENTS).splitlines() == [
        "| seeing | DIP |",
        "| --- | ---: |",
        '| 0.35" | 41 nm |',
        '| 1.00" | 60 nm |',
        '| 1.00" | 70 nm |',
        "",
        "20 cubes, seed 5.",
    ]


def test_a_member_is_found_by_its_values():
    conditions = find(EXPERIMENTS, "methods/results/methods/conditions")
    assert find(conditions, "seeing_arcsec=1.0") is conditions[1]
    assert find(conditions, "seeing_arcsec=1.0,shape=b") is conditions[2]
    assert cell("{shape=b/median_nm/dip:g}", conditions) == "70"


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (layout(rows=[["{method/seed}"]]), "no 'method' on the path 'method/seed'; there is methods"),
        (layout(rows=[["{methods/results/methods/conditions/7}"]]), "no '7' .*; there is a list of 3"),
        (layout(rows=[["{methods/results/methods/conditions/shape=c}"]]), "no 'shape=c' .* a list of 3"),
        (layout(rows=[["{methods/seed/x}"]]), "no 'x' .*; there is 5"),
        (layout(rows=[["1", "2"]]), "a row has 2 cells for 1 columns: 1, 2"),
    ],
)
def test_a_layout_that_does_not_fit_says_why(table, message):
    with pytest.raises(ConfigurationError, match=message):
        render_table(table, EXPERIMENTS)


def test_only_what_stands_between_the_marks_is_replaced():
    text = (
        "before\n<!-- paper:one -->\nold\nolder\n<!-- /paper -->\nafter\n"
        "<!-- paper:two -->\n<!-- /paper -->\n"
    )
    tables = {"one": layout(rows=[["1"]]), "two": layout(rows=[["{methods/seed}"]])}
    new = with_tables(text, rendered(tables, EXPERIMENTS))
    assert new == (
        "before\n<!-- paper:one -->\n| a |\n| --- |\n| 1 |\n<!-- /paper -->\nafter\n"
        "<!-- paper:two -->\n| a |\n| --- |\n| 5 |\n<!-- /paper -->\n"
    )
    assert with_tables(new, rendered(tables, EXPERIMENTS)) == new


@pytest.mark.parametrize(
    ("text", "rows", "message"),
    [
        (
            "<!-- paper:onne -->\n<!-- /paper -->",
            [],
            "<!-- paper:onne -->: no such table; did you mean 'one'",
        ),
        ("no mark", [], "table 'one': no <!-- paper:one --> in the text"),
        ("<!-- paper:one -->\n<!-- /paper -->", [["{x}"]], "table 'one': no 'x' on the path 'x'"),
    ],
)
def test_a_mark_without_table_or_a_table_without_mark_is_an_error(text, rows, message):
    with pytest.raises(ConfigurationError, match=message):
        with_tables(text, rendered({"one": layout(rows=rows)}, EXPERIMENTS))


def test_a_mistake_in_the_layout_is_reported_with_its_line(tmp_path):
    path = tmp_path / "tables.yaml"
    path.write_text("one:\n  columns: [a]\n  rowws: []\n")
    with pytest.raises(ConfigurationError, match=r"tables\.yaml:3: unknown key 'one\.rowws'; did you mean"):
        read_layouts(path)


def make_tree(root: Path, rows: str) -> None:
    (root / "docs").mkdir()
    blocks = "\n".join(f"<!-- paper:{name} -->\n<!-- /paper -->" for name in ("one", "code", "checks"))
    (root / PAGE).write_text(f"# x\n{blocks}\n")
    (root / RESULTS).write_text(json.dumps(results(methods="1.0")))
    (root / "docs/paper_tables.yaml").write_text(f"one: {{columns: [a], rows: {rows}}}\n")


def results(*, day: str = "2026-11-22", missing=(), quick: bool = False, **code: str) -> dict:
    """Content of paper_results.json whose experiments were computed with the `code` given for each."""
    runs = {
        name: {"stage": {"software": {"irlos_pipe": state}, "finished": f"{day}T03:00:00+00:00"}}
        for name, state in code.items()
    }
    experiments = dict.fromkeys(code, EXPERIMENTS["methods"])
    return {"quick": quick, "missing": list(missing), "experiments": experiments, "runs": runs}


def renew(root: Path, *options: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "irlos_pipe.paper.run.results_page", str(root), *options],
        capture_output=True,
        text=True,
        cwd=REPOSITORY,
    )


@pytest.mark.slow
def test_the_command_renews_the_page_of_a_source_tree(tmp_path):
    make_tree(tmp_path, "[['{methods/seed}']]")
    assert renew(tmp_path).stdout.endswith("docs/results.md: renewed\n")
    assert "| 5 |" in (tmp_path / PAGE).read_text()
    assert "| 1.0 | 2026-11-22 | `methods` |" in (tmp_path / PAGE).read_text()
    assert renew(tmp_path).stdout.endswith("docs/results.md: unchanged\n")


def test_the_command_reports_a_mistake_in_one_line(tmp_path):
    make_tree(tmp_path, "[['{seed}']]")
    result = renew(tmp_path)
    assert result.returncode == 1
    assert result.stderr == "irlos: error: table 'one': no 'seed' on the path 'seed'; there is methods\n"


# -- states of the code ------------------------------------------------------------------------------


def written(tmp_path: Path, content: dict) -> Path:
    path = tmp_path / "paper_results.json"
    path.write_text(json.dumps(content))
    return path


def test_experiments_are_told_by_their_code():
    content = results(methods="1.0", faint="1.1", capture="1.0")
    assert states_of(content) == {"1.0": ["methods", "capture"], "1.1": ["faint"]}


def test_a_run_of_one_state_of_the_code_is_taken_and_one_of_two_is_not(tmp_path):
    make_tree(tmp_path, "[['1']]")
    take(tmp_path, written(tmp_path, results(methods="1.1", faint="1.1")), others_stay=False)
    assert [*json.loads((tmp_path / RESULTS).read_text())["experiments"]] == ["methods", "faint"]
    with pytest.raises(ConfigurationError, match=r"2 states of the code \(1\.1: methods; 1\.2: faint\)"):
        take(tmp_path, written(tmp_path, results(methods="1.1", faint="1.2")), others_stay=False)


def test_beside_others_only_its_own_experiments_are_replaced_and_the_page_tells_the_states(tmp_path):
    make_tree(tmp_path, "[['1']]")
    (tmp_path / RESULTS).write_text(json.dumps(results(methods="1.0", faint="1.0")))
    new = written(tmp_path, results(day="2026-11-24", faint="1.2", missing=["methods"]))
    take(tmp_path, new, others_stay=True)
    assert states_of(json.loads((tmp_path / RESULTS).read_text())) == {"1.0": ["methods"], "1.2": ["faint"]}
    assert "| 1.2 | 2026-11-24 | `faint` |" in renewed(tmp_path)


@pytest.mark.parametrize(
    ("content", "others_stay", "message"),
    [
        (results(methods="1.0", missing=["faint"]), False, "has no faint"),
        (results(methods="1.0", quick=True), False, "has small samples"),
        (results(methods="1.0", quick=True), True, "has small samples"),
    ],
)
def test_a_run_that_lacks_experiments_or_is_a_quick_look_is_not_taken(
    tmp_path, content, others_stay, message
):
    make_tree(tmp_path, "[['1']]")
    with pytest.raises(ConfigurationError, match=message):
        take(tmp_path, written(tmp_path, content), others_stay)


@pytest.fixture
def committed() -> dict:
    """Numbers that stand in the source tree."""
    if not (REPOSITORY / RESULTS).is_file():
        pytest.skip("docs/paper_results.json is not there: make paper, make paper-tables")
    return json.loads((REPOSITORY / RESULTS).read_text(encoding="utf-8"))


def test_the_committed_numbers_are_those_of_the_full_recipes_as_they_are_now(committed):
    assert (committed["schema"], committed["quick"], committed["missing"]) == ("irlos-paper", False, [])
    known = find_experiments(REPOSITORY / "recipes/paper")
    assert list(committed["experiments"]) == [one.name for one in known]
    for one in known:
        found = committed["experiments"][one.name]
        assert (found["seed"], found["sizes"]) == (one.recipe.seed, jsonable(one.recipe.configs))


def test_the_page_agrees_with_the_committed_numbers(committed):
    assert (REPOSITORY / PAGE).read_text(encoding="utf-8") == renewed(REPOSITORY), "run: make paper-tables"
