"""Figures that several experiments draw of their tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.figure import Figure as Canvas

from irlos_pipe.paper.common.table import Frame
from irlos_pipe.report.content import Figure, Width
from irlos_pipe.report.drawing import BLUE, CYCLE, INK, ORANGE, svg

MARKERS = ("o", "s", "^", "D", "v", "P")


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
