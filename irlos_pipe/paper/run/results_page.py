"""Renew the tables of docs/results.md: ``python -m irlos_pipe.paper.run.results_page``.

The numbers are those of docs/paper_results.json. A table that docs/paper_tables.yaml lays out stands between
``<!-- paper:NAME -->`` and ``<!-- /paper -->``; the text around the tables is kept.
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
from irlos_pipe.files.validation import Origins, ValidationErrors
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.paper.run.tables import TableLayout, render_table

PAGE, RESULTS, LAYOUT = (
    Path("docs/results.md"),
    Path("docs/paper_results.json"),
    Path("docs/paper_tables.yaml"),
)
BLOCK = re.compile(r"(<!-- paper:(\S+) -->\n).*?(<!-- /paper -->)", re.DOTALL)


def with_tables(text: str, layouts: Mapping[str, TableLayout], experiments: Mapping[str, Any]) -> str:
    """Return the text with every table renewed.

    Parameters
    ----------
    text : str
        The page, with the marks of the tables.
    layouts : mapping of str to TableLayout
        Layouts by the name of the table.
    experiments : mapping
        Results of the experiments by name.

    Raises
    ------
    ConfigurationError
        If a table has no layout or no mark in the text, or cannot be made.
    """
    named = {found[2] for found in BLOCK.finditer(text)}
    for name in named - layouts.keys():
        raise ConfigurationError(f"<!-- paper:{name} -->: no such table{suggestion(name, layouts)}")
    for name in layouts.keys() - named:
        raise ConfigurationError(f"table '{name}': no <!-- paper:{name} --> in the text")
    return BLOCK.sub(lambda found: f"{found[1]}{_table(found[2], layouts, experiments)}\n{found[3]}", text)


def _table(name: str, layouts: Mapping[str, TableLayout], experiments: Mapping[str, Any]) -> str:
    try:
        return render_table(layouts[name], experiments)
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
    return with_tables(text, read_layouts(root / LAYOUT), results["experiments"])


def main() -> None:
    """Renew the tables of docs/results.md in a source tree."""
    parser = argparse.ArgumentParser(
        prog="python -m irlos_pipe.paper.run.results_page", description=main.__doc__
    )
    parser.add_argument("root", nargs="?", default=".", type=Path, help="the source tree (default: here)")
    root = parser.parse_args().root
    try:
        changed = write_if_changed(root / PAGE, renewed(root).encode())
    except (IrlosError, OSError) as error:
        raise SystemExit(f"irlos: error: {error}") from None
    print(f"{root / PAGE}: {'renewed' if changed else 'unchanged'}")


if __name__ == "__main__":
    main()
