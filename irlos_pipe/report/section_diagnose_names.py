"""The names that a diagnosis found: how they compared, their sizes, what they are not distinguished from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.effects.public_values import rows_of
from irlos_pipe.report.content import Figure, Table
from irlos_pipe.report.drawing import BLUE, ORANGE, svg
from irlos_pipe.report.text import number, rounded_by_error
from irlos_pipe.stages.diagnose.results import AlternativeRow, DiagnoseResults, RankedRow, StepRow

BAR_IN, WIDTH_IN = 0.22, 4.4
COLUMNS = (
    "name",
    "parameter",
    "value",
    "significance",
    "explained",
    "explained where it acts",
    "not distinguished from",
)


def ranking_figures(results: DiagnoseResults) -> list[Figure]:
    """Candidates for the first name, if there are any."""
    ranking = [row for step in _found(results)[:1] for row in step.ranking]
    if not ranking:
        return []
    caption = "Part of the excess over noise that each name explains when fitted; significance in σ."
    return [Figure(ranking_bars("dia-ranking", ranking), "Candidates", caption, "full")]


def step_tables(results: DiagnoseResults) -> list[Table]:
    """Names with value, standard error and share; the nearest one where the verdict is unknown."""
    rows = [row for step in _found(results) for row in _step_rows(step)]
    title = "Found" if results.steps else "Nearest"
    return [Table(COLUMNS, rows, title)] if rows else []


def separation_tables(results: DiagnoseResults) -> list[Table]:
    """What would distinguish the names from others that fit as well."""
    rows = [
        (f"{step.effect} or {other.name}", other.reason, _what_separates(other))
        for step in results.steps
        for other in step.alternatives
    ]
    return [Table(("effects", "why", "what distinguishes them"), rows, "Not distinguished")] if rows else []


def _found(results: DiagnoseResults) -> list[StepRow]:
    """Effects found, and the nearest where the verdict is unknown."""
    return [*results.steps, *([results.nearest] if results.nearest else [])]


def _step_rows(step: StepRow) -> list[tuple[str, ...]]:
    values, errors = rows_of(step.parameters), dict(rows_of(step.sigma))
    head = (
        number(step.significance, ".1f", "σ"),
        number(step.explained, ".0%"),
        number(step.share, ".1%"),
        ", ".join(step.indistinguishable) or "–",
    )
    return [
        (
            step.effect if first else "",
            f"{name} (unusual)" if name in step.unusual else name,
            rounded_by_error(value, errors.get(name)) if isinstance(value, float) else str(value),
            *(head if first else [""] * len(head)),
        )
        for first, (name, value) in zip([True] + [False] * len(values), values, strict=False)
    ]


def _what_separates(other: AlternativeRow) -> str:
    """What separates two effects, and the second recording in which they are least alike."""
    if not other.second_recording:
        return other.separated_by
    cosine = number(other.likeness_then, ".2f")
    return f"{other.separated_by}; a second recording {other.second_recording} (|cos| then {cosine})"


def ranking_bars(name: str, ranking: Sequence[RankedRow]) -> Markup:
    """Draw what every candidate of a `ranking` explains, the best on top; `name` is unique in the page."""
    explained = np.nan_to_num([row.explained for row in ranking])
    rows = np.arange(len(ranking))

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        axes.barh(rows, np.clip(explained, 0, 1), 0.7, color=[BLUE, *[ORANGE] * (len(rows) - 1)])
        labels = [f"{row.name}, {row.significance:.0f} σ" for row in ranking]
        axes.set(yticks=rows, yticklabels=labels, ylim=(len(rows) - 0.4, -0.6), xlim=(0, 1))
        axes.set_xlabel("explained part of the excess")
        axes.grid(axis="y", visible=False)

    return svg(name, (WIDTH_IN, 0.7 + BAR_IN * len(ranking)), draw)
