"""Markdown tables from paper_results.json, as a YAML file lays them out.

A table is::

    methods:
      from: methods/results/methods          # where paths begin; the experiments by name if absent
      columns: [method, 'median [nm]']
      rows:                                  # cells are text with {path:format} in it
        - [DIP global, '{conditions/seeing_arcsec=0.35/modes/dip_global/median_nm:.1f}']
      each: conditions                       # and, or instead: one row for every member of a list,
      row: ['{seeing_arcsec}', '{samples}']  # whose paths begin at the member
      note: '{samples} cubes'                # a line below

Steps of a path are separated by ``/``: a key, the number of a list's member, or ``key=value`` (more
of them separated by commas) for the first member that has these values.
"""

from __future__ import annotations

import string
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from irlos_pipe.conventions.errors import ConfigurationError

MISSING = "–"


class TableLayout(BaseModel):
    """One table, see the docstring of the module."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    start: str = Field("", alias="from", description="path at which all others begin")
    columns: list[str] = Field(min_length=1, description="titles of the columns")
    rows: list[list[str]] = Field([], description="cells of every row")
    each: str | None = Field(None, description="path of a list")
    row: list[str] = Field([], description="cells for each of its members")
    note: str = Field("", description="line below the table")


def render_table(layout: TableLayout, experiments: Mapping[str, Any]) -> str:
    """Return the table as Markdown, the first column to the left and the others to the right.

    Parameters
    ----------
    layout : TableLayout
    experiments : mapping
        Content of paper_results.json by experiment.

    Raises
    ------
    ConfigurationError
        When a path leads nowhere, or a row has another number of cells than there are columns.
    """
    root = find(experiments, layout.start)
    rows = [[cell(text, root) for text in row] for row in layout.rows]
    if layout.each is not None:
        rows += [[cell(text, member) for text in layout.row] for member in find(root, layout.each)]
    rules = ["---", *["---:"] * (len(layout.columns) - 1)]
    lines = [_line(row, len(layout.columns)) for row in (layout.columns, rules, *rows)]
    return "\n".join([*lines, *(["", cell(layout.note, root)] if layout.note else [])])


def plain_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return `rows` of finished cells under their `columns` as Markdown."""
    return "\n".join(_line(cells, len(columns)) for cells in (columns, ["---"] * len(columns), *rows))


def cell(text: str, root: Any) -> str:
    """Return `text` with every ``{path:format}`` replaced by its value in `root`; null becomes a dash."""
    return _PathFormatter(root).format(text)


def find(root: Any, path: str) -> Any:
    """Return what the `path` leads to from `root`.

    Raises
    ------
    ConfigurationError
        When it leads nowhere.
    """
    found = root
    for step in filter(None, path.split("/")):
        try:
            found = _member(found, step)
        except (KeyError, IndexError, ValueError, TypeError, StopIteration):
            there = _content(found)
            raise ConfigurationError(f"no '{step}' on the path '{path}'; there is {there}") from None
    return found


def _member(content: Any, step: str) -> Any:
    if isinstance(content, Mapping):
        return content[step]
    if "=" in step:
        wanted = dict(part.split("=") for part in step.split(","))
        return next(one for one in content if all(str(one[key]) == value for key, value in wanted.items()))
    return content[int(step)]


def _content(found: Any) -> str:
    if isinstance(found, Mapping):
        return ", ".join(found)
    return f"a list of {len(found)}" if isinstance(found, list) else repr(found)


def _line(cells: Sequence[str], columns: int) -> str:
    if len(cells) != columns:
        raise ConfigurationError(f"a row has {len(cells)} cells for {columns} columns: {', '.join(cells)}")
    return f"| {' | '.join(cells)} |"


class _PathFormatter(string.Formatter):
    """Takes what stands in braces for a path."""

    def __init__(self, root: Any) -> None:
        self._root = root

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> tuple[Any, str]:
        return find(self._root, field_name), field_name

    def format_field(self, value: Any, format_spec: str) -> str:
        return MISSING if value is None else super().format_field(value, format_spec)
