"""Renew the tables of docs/results.md: ``python -m irlos_pipe.paper.run.results_page``.

The numbers are those of docs/paper_results.json. A table that docs/paper_tables.yaml lays out stands between
``<!-- paper:NAME -->`` and ``<!-- /paper -->``, those of the states of the code and of the checks under the
names ``code`` and ``checks``; the text around the tables is kept.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.files.atomic import write_if_changed
from irlos_pipe.files.json import json_text
from irlos_pipe.files.validation import Origins, ValidationErrors
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.paper.run.checks import table_of_checks
from irlos_pipe.paper.run.states import beside, require_one_state, table_of_states
from irlos_pipe.paper.run.tables import TableLayout, render_table

PAGE, RESULTS, LAYOUT = (
    Path("docs/results.md"),
    Path("docs/paper_results.json"),
    Path("docs/paper_tables.yaml"),
)
OF_ALL = {"code": table_of_states, "checks": table_of_checks}  # tables of all experiments, by name
BLOCK = re.compile(r"(<!-- paper:(\S+) -->\n).*?(<!-- /paper -->)", re.DOTALL)


def with_tables(text: str, tables: Mapping[str, str]) -> str:
    """Return the text with every table renewed.

    Parameters
    ----------
    text : str
        The page, with the marks of the tables.
    tables : mapping of str to str
        In Markdown, by name.

    Raises
    ------
    ConfigurationError
        If there is no table for a mark, or no mark for a table.
    """
    named = {found[2] for found in BLOCK.finditer(text)}
    for name in named - tables.keys():
        raise ConfigurationError(f"<!-- paper:{name} -->: no such table{suggestion(name, tables)}")
    for name in tables.keys() - named:
        raise ConfigurationError(f"table '{name}': no <!-- paper:{name} --> in the text")
    return BLOCK.sub(lambda found: f"{found[1]}{tables[found[2]]}\n{found[3]}", text)


def rendered(layouts: Mapping[str, TableLayout], experiments: Mapping[str, Any]) -> dict[str, str]:
    """Return all tables in Markdown, by name.

    Parameters
    ----------
    layouts : mapping of str to TableLayout
    experiments : mapping
        Results of the experiments by name.

    Raises
    ------
    ConfigurationError
        If a table cannot be made.
    """
    return {name: _table(name, layout, experiments) for name, layout in layouts.items()}


def _table(name: str, layout: TableLayout, experiments: Mapping[str, Any]) -> str:
    try:
        return render_table(layout, experiments)
    except ConfigurationError as error:
        raise ConfigurationError(f"table '{name}': {error}") from None


def read_layouts(path: Path) -> dict[str, TableLayout]:
    """Read the layouts of all tables, by name.

    Raises
    ------
    ConfigurationError
        With one line ``file:line: problem`` for everything that is wrong.
    """
    written, lines = load_yaml(path)
    errors = ValidationErrors(Origins(path, lines))
    layouts = {name: errors.validated(content, TableLayout, (name,)) for name, content in written.items()}
    errors.raise_if_any()
    return {name: layout for name, layout in layouts.items() if layout}


def renewed(root: Path) -> str:
    """Return docs/results.md of a source tree with its tables made from the results there."""
    results = json.loads((root / RESULTS).read_text(encoding="utf-8"))
    text = (root / PAGE).read_text(encoding="utf-8")
    tables = rendered(read_layouts(root / LAYOUT), results["experiments"])
    of_all = {name: table(results) for name, table in OF_ALL.items()}
    return with_tables(text, tables | of_all)


def take(root: Path, source: Path, others_stay: bool) -> None:
    """Make the numbers of a run of `irlos paper` those of a source tree.

    Parameters
    ----------
    root : Path
        The source tree.
    source : Path
        Paper_results.json of the run.
    others_stay : bool
        Put its experiments beside those that are there, which may be of other states of the code.

    Raises
    ------
    ConfigurationError
        If samples are small, experiments are missing, or of several states of the code.
    """
    results = json.loads(source.read_text(encoding="utf-8"))
    if results["quick"]:
        raise ConfigurationError(f"{source} has small samples (--quick)")
    if others_stay:
        results = beside(json.loads((root / RESULTS).read_text(encoding="utf-8")), results)
    else:
        require_one_state(results)
    if results["missing"]:
        raise ConfigurationError(f"{source} has no {', '.join(results['missing'])}")
    write_if_changed(root / RESULTS, json_text(results).encode())


def main() -> None:
    """Renew the tables of docs/results.md in a source tree."""
    parser = argparse.ArgumentParser(
        prog="python -m irlos_pipe.paper.run.results_page", description=main.__doc__
    )
    parser.add_argument("root", nargs="?", default=".", type=Path, help="the source tree (default: here)")
    parser.add_argument("--take", type=Path, metavar="FILE", help="paper_results.json of a run, to be shown")
    parser.add_argument("--beside", action="store_true", help="keep experiments that FILE does not have")
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
