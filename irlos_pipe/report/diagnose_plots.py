"""Drawings of a diagnosis: bars of the gap and of the candidates, maps of the pupil."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from irlos_pipe.report.drawing import BLUE, INK, ORANGE, svg
from irlos_pipe.report.images import PANEL_IN, SIGNED, panel_axes, symmetric_scale

GAP_IN, BAR_IN, WIDTH_IN = (3.7, 2.85), 0.22, 4.4
MAP_PERCENTILE = 99.5


def gap_bars(name: str, gap: Mapping[str, float]) -> Markup:
    """Draw the gap before and after against its floor."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.bar(["before", "after"], [gap["before"], gap["after"]], 0.6, color=[ORANGE, BLUE])
        axes.axhline(gap["floor"], color=INK, linestyle="--", linewidth=0.9, label="noise alone")
        axes.set(ylabel="gap, part of the light", ylim=(0, None))
        axes.grid(axis="x", visible=False)
        axes.legend()

    return svg(name, GAP_IN, draw)


def ranking_bars(name: str, ranking: Sequence[Mapping[str, Any]]) -> Markup:
    """Draw what every candidate explains, the best on top, with its significance."""
    explained = np.nan_to_num([float(row["explained"] or 0) for row in ranking])
    rows = np.arange(len(ranking))

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.barh(rows, np.clip(explained, 0, 1), 0.7, color=[BLUE, *[ORANGE] * (len(rows) - 1)])
        labels = [f"{row['name']}, {row['significance']:.0f} σ" for row in ranking]
        axes.set(yticks=rows, yticklabels=labels, ylim=(len(rows) - 0.4, -0.6), xlim=(0, 1))
        axes.set_xlabel("explained part of the excess")
        axes.grid(axis="y", visible=False)

    return svg(name, (WIDTH_IN, 0.7 + BAR_IN * len(ranking)), draw)


def pupil_map(name: str, values: np.ndarray, unit: str) -> Markup:
    """Draw a map of the pupil, (n, n), about zero."""
    shown = np.where(values == 0, np.nan, values)
    limit = float(np.nanpercentile(np.abs(shown), MAP_PERCENTILE))

    def draw(figure: Figure) -> None:
        axes, bar = panel_axes(figure)
        image = axes.imshow(
            shown, norm=symmetric_scale(limit), cmap=SIGNED, origin="lower", interpolation="none"
        )
        axes.set(xticks=[], yticks=[])
        figure.colorbar(image, cax=bar, label=unit)

    return svg(name, PANEL_IN, draw)
