"""Tables of an experiment: rows of numbers as pandas frames, in JSON, as CSV, and in words.

Names of columns carry the units. A quantity `x` with a spread over samples is their median and has the
further columns ``x_p16`` and ``x_p84`` (percentiles); with a range in which it lies, ``x_low`` and ``x_high``
(90 %, by bootstrap over the samples).
"""

import csv
import io
import math
import string
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure as Canvas
from scipy import stats

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.units import ONE_SIGMA
from irlos_pipe.product.product import Check
from irlos_pipe.report.content import Figure, Table, Width
from irlos_pipe.report.drawing import BLUE, CYCLE, INK, ORANGE, svg
from irlos_pipe.report.text import MISSING

try:
    import pandas as pd
except ImportError as error:
    raise ConfigurationError(
        "the experiments of the paper need pandas; install it with: pip install 'irlos_pipe[paper]'"
    ) from error

Frame = Any  # pandas.DataFrame, which has no types
Record = Mapping[str, Any]
Tables = Mapping[str, Frame]
DRAWS, BOOTSTRAP_SEED = 4000, 0
TAIL = 0.05  # probability beyond each end of a range of 90 %

MARKERS = ("o", "s", "^", "D", "v", "P")


def frame(rows: Iterable[Record]) -> Frame:
    """Return rows as a frame; None and what a row lacks become NaN."""
    return pd.DataFrame([{key: math.nan if one is None else one for key, one in row.items()} for row in rows])


def grouped(rows: Frame, by: Sequence[str], summary: Callable[..., Record | Iterable[Record]]) -> Frame:
    """Return what `rows` with the same values in the columns `by` are summarised to, as they appear.

    ``summary(group, *values)`` returns the other columns of a group's row, or of its rows.
    """
    found = []
    for values, group in rows.groupby(list(by), sort=False, dropna=False):
        own = summary(group, *values)
        for one in [own] if isinstance(own, Mapping) else own:
            found.append({**dict(zip(by, values, strict=True)), **one})
    return frame(found)


def stacked(rows: Frame, *names: str) -> list[np.ndarray]:
    """Return columns of arrays, each as one array (rows, ...)."""
    return [np.stack(list(rows[name])) for name in names]


# -- statistics over samples -------------------------------------------------------------------------


def spreads(rows: Mapping[str, Any], *names: str) -> dict[str, float]:
    """Return the medians of some columns and their percentiles at -1σ and +1σ."""
    found: dict[str, float] = {}
    for name in names:
        low, median, high = map(float, np.percentile(rows[name].to_numpy(float), ONE_SIGMA))
        found |= {name: median, f"{name}_p16": low, f"{name}_p84": high}
    return found


def median_in_range(name: str, values: Any) -> dict[str, float]:
    """Return the median of one value per sample, and the range in which it lies, as columns of `name`."""
    found = np.asarray(values, float)
    low, high = _range(np.median(_redrawn(found), axis=1), len(found))
    return {name: float(np.median(found)), f"{name}_low": low, f"{name}_high": high}


def rms_in_range(name: str, values: Any) -> dict[str, float]:
    """Return the root of the mean square of one value per sample, and the range in which it lies."""
    squares = np.square(np.asarray(values, float))
    low, high = np.sqrt(_range(_redrawn(squares).mean(axis=1), len(squares))).tolist()
    return {name: float(np.sqrt(squares.mean())), f"{name}_low": low, f"{name}_high": high}


def _range(redrawn: np.ndarray, samples: int) -> list[float]:
    """Return the range of 90 % from the numbers of redrawn samples, wider where there are few samples.

    Percentiles alone are too narrow then. These are the expanded ones of Hesterberg 2015, Am. Stat. 69, 371;
    of three samples they are nearly the smallest and the largest, which hold the truth in some 75 % only.
    """
    if samples < 2:
        return [math.nan, math.nan]
    reach = np.sqrt(samples / (samples - 1)) * stats.t.isf(TAIL, samples - 1)
    return np.quantile(redrawn, stats.norm.cdf([-reach, reach])).tolist()


def _redrawn(values: np.ndarray) -> np.ndarray:
    """Return samples drawn from these with replacement, (DRAWS, samples)."""
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    return values[rng.integers(len(values), size=(DRAWS, len(values)))]


# -- checks ------------------------------------------------------------------------------------------

Number = str | float | Callable[[Record], float]
"""A number, a column, or what is computed of a row."""


def check(
    name: str, value: float, text: str, *, low: float | None = None, high: float | None = None, unit: str = ""
) -> Check:
    return Check(name, float(value), unit, low, high, text)


def checked(
    rows: Frame,
    name: str,
    value: Number,
    text: str,
    *,
    low: Number | None = None,
    high: Number | None = None,
    unit: str = "",
) -> list[Check]:
    """Return a check of every row of a frame; `name` and `text` are patterns of its columns and ``value``."""

    def number(given: Number | None, row: Record) -> Any:
        return row[given] if isinstance(given, str) else given(row) if callable(given) else given

    found = []
    for row in rows.to_dict("records"):
        own, limits = number(value, row), {"low": number(low, row), "high": number(high, row)}
        named = {**row, "value": own}
        found.append(check(name.format(**named), own, text.format(**named), **limits, unit=unit))
    return found


# -- files -------------------------------------------------------------------------------------------


def csv_text(rows: Sequence[Record]) -> str:
    """Return rows as CSV; floats have all their digits, None is nothing."""
    text, columns = io.StringIO(), dict.fromkeys(key for row in rows for key in row)
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def csv_of_tables(tables: Mapping[str, Iterable[Record]]) -> str:
    """Return tables as one CSV, their names in the first column."""
    return csv_text([{"table": name, **row} for name, records in tables.items() for row in records])


def read_csv(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


# -- tables for people -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Listing:
    """A table for the report and for docs/results.md."""

    of: str  # name of the table that it shows
    title: str
    cells: Mapping[str, str]  # headings, and patterns of the cells below: text with ``{column:format}`` in it
    # The same, the headings being patterns as well: rows with equal `cells` become one, and what differs
    # stands side by side.
    across: Mapping[str, str] = field(default_factory=dict)
    heads: Sequence[str] = ()  # which headings of `across` are shown, in this order; all if empty
    where: str = ""  # which rows, as `DataFrame.query` reads it
    caption: str = ""  # pattern for the first of these rows
    # Columns of a value and of its limit, by which a row is good or bad; without a limit it is neither.
    limit: tuple[str, str] | None = None
    page: str = ""  # name of the table in docs/results.md; it is not shown there without

    def table(self, tables: Tables, *, ranges: bool = True) -> Table:
        """Return the finished table; with `ranges`, a quantity that has a spread has it in brackets."""
        chosen = tables[self.of].query(self.where, engine="python") if self.where else tables[self.of]
        records = chosen.to_dict("records")
        columns = list(self.cells)
        body = [[filled(cell, row, ranges) for cell in self.cells.values()] for row in records]
        if self.across:
            found: dict[tuple[str, ...], dict[str, str]] = {}
            for row, own in zip(records, body, strict=True):
                further = {filled(head, row): filled(cell, row, ranges) for head, cell in self.across.items()}
                found.setdefault(tuple(own), {}).update(further)
            heads = self.heads or list(dict.fromkeys(head for further in found.values() for head in further))
            columns += heads
            body = [[*own, *(further.get(head, MISSING) for head in heads)] for own, further in found.items()]
        pairs = [(row[self.limit[0]], row[self.limit[1]]) for row in records] if self.limit else ()
        marks = ["" if math.isnan(most) else "good" if value <= most else "bad" for value, most in pairs]
        return Table(columns, body, self.title, filled(self.caption, records[0]) if records else "", marks)


def filled(pattern: str, row: Record, ranges: bool = False) -> str:
    """Return a pattern filled from the columns of a row; what is missing becomes a dash."""
    return _Pattern(row, ranges).format(pattern)


class _Pattern(string.Formatter):
    """Takes what stands in braces for a column of a row."""

    def __init__(self, row: Record, ranges: bool) -> None:
        self._row, self._ranges = row, ranges

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> tuple[Any, str]:
        row = self._row
        ends = [row.get(f"{field_name}_{end}", math.nan) for end in ("p16", "p84")] if self._ranges else []
        return (row.get(field_name), *ends), field_name

    def format_field(self, value: Any, format_spec: str) -> str:
        own, *ends = (MISSING if _missing(one) else format(one, format_spec) for one in value)
        return f"{own} ({ends[0]}…{ends[1]})" if ends and MISSING not in ends else own


def _missing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and not math.isfinite(value))


def lines(
    name: str,
    title: str,
    caption: str,
    table: Frame,
    x: str,
    y: str,
    *,
    colour: str,
    labels: tuple[str, str],
    panels: str = "",
    dashed: str = "",
    ends: Sequence[str] = (),
    levels: Sequence[float] = (),
    marks: Sequence[float] = (),
    size: tuple[float, float] = (5.2, 4.4),
    width: Width = "half",
    **axes_: Any,
) -> Figure:
    """Draw the column `y` of a table against `x`, one line for every value of the column `colour`.

    The `name` is unique in the page, `labels` are those of the axes. Every value of the column `panels` has
    and names a panel of its own, `dashed` is a further column, drawn dashed, and `ends` are the endings of
    the columns between which error bars go. Dotted lines go across at `levels`, and upright at `marks`;
    `axes_` are further properties of the axes.
    """

    def draw(figure: Canvas) -> None:
        parts = list(table.groupby(panels, sort=False)) if panels else [("", table)]
        looks = dict(zip(table[colour].unique(), cycle(zip(CYCLE, MARKERS, strict=True))))
        all_axes = figure.subplots(1, len(parts), sharey=True, squeeze=False)[0]
        for axes, (heading, part) in zip(all_axes, parts, strict=True):
            for key, line in part.groupby(colour, sort=False):
                ink, marker = looks[key]
                reach = [abs(line[f"{y}_{end}"] - line[y]) for end in ends] or None
                axes.errorbar(line[x], line[y], reach, color=ink, fmt=f"{marker}-", markersize=4, label=key)
                if dashed:
                    axes.plot(line[x], line[dashed], "--", color=ink, linewidth=0.9)
            for draw_line, places in ((axes.axhline, levels), (axes.axvline, marks)):
                for place in places:
                    draw_line(place, color=INK, linestyle=":", linewidth=0.9)
            axes.set(**{"title": heading, "xlabel": labels[0], "yscale": "log"} | axes_)
        all_axes[0].set_ylabel(labels[1])
        figure.legend(*all_axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)

    return Figure(svg(name, size, draw), title, caption, width)


def strips(
    name: str,
    title: str,
    caption: str,
    rows: Frame,
    columns: Mapping[str, str],
    *,
    by: str,
    label: str,
    levels: Sequence[float] = (),
    inches: float = 5.4,
    width: Width = "half",
) -> Figure:
    """Draw every value of some `columns`, and their medians, in one line for every value of the column `by`.

    `name` is unique in the page, `columns` say what they are, `label` is that of the axis.
    """
    keys = list(rows[by].unique())[::-1]
    shifts = np.linspace(0.17, -0.17, len(columns)) if len(columns) > 1 else [0.0]
    looks = list(zip(shifts, columns.items(), (BLUE, ORANGE), "os", strict=False))

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        for place, key in enumerate(keys):
            for shift, (column, what), ink, marker in looks:
                values = rows.loc[rows[by] == key, column].to_numpy(float)
                height = np.full(len(values), place + shift)
                named = what if place == 0 else None
                axes.plot(values, height, marker, color=ink, markersize=3.5, alpha=0.7, label=named)
                bar = place + shift - 0.15, place + shift + 0.15
                axes.vlines(np.median(values), *bar, color=INK, linewidth=1.4)
        for level in levels:
            axes.axvline(level, color=INK, linestyle=":", linewidth=0.9)
        axes.set_yticks(range(len(keys)), keys)
        axes.set(xlabel=label, xscale="log")
        figure.legend(loc="outside upper center", ncols=2)

    size = inches, 1.0 + 0.26 * len(columns) * len(keys)
    return Figure(svg(name, size, draw), title, caption, width)
