"""The names that a diagnosis found: how they compared, their sizes, what they are not distinguished from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.diagnosis.records import Alternative, Ranked
from irlos_pipe.report.content import Figure, Table
from irlos_pipe.report.drawing import BLUE, ORANGE, svg
from irlos_pipe.report.effect_words import MOST_ROWS, Row, parameter_rows, shortened
from irlos_pipe.report.text import MISSING, number
from irlos_pipe.stages.diagnose.results import DiagnoseResults, StepRow

BAR_IN, WIDTH_IN = 0.24, 3.9
FEW = 3  # candidates, below which a table shows all
COLUMNS = (
    "name",
    "parameter",
    "value",
    "unit",
    "significance",
    "explained",
    "explained where it acts",
    "z, unseen data",
    "not distinguished from",
)
CANDIDATES = ("name", "explained", "Δχ² to the first", "significance", "z, unseen data against it")
CAPTION = (
    "Significance: of the fall of χ² by the fit. Explained: part of the excess over noise; where it acts: of "
    "its own signal, where that lies. z: by how much data that no fit has seen prefer the model with the "
    "name, 3 is clear. Petals and segments are told as differences from their mean."
)


def ranking_figures(results: DiagnoseResults) -> list[Figure]:
    """Candidates for the first name, if there are any."""
    ranking = [row for step in _found(results)[:1] for row in step.ranking]
    if len(ranking) < FEW:
        return []
    caption = "Part of the excess over noise that each name explains when fitted."
    return [Figure(ranking_bars("dia-ranking", ranking), "Candidates for the first name", caption, "third")]


def candidate_tables(results: DiagnoseResults) -> list[Table]:
    """Return how the candidates for every name compared, where there were several."""
    tables = []
    for step in _found(results):
        rows = [_candidate(step.ranking[0], row) for row in step.ranking]
        if len(rows) > 1:
            tables.append(Table(CANDIDATES, rows, f"Candidates for {step.effect.replace('_', ' ')}"))
    return tables


def _candidate(first: Ranked, row: Ranked) -> tuple[str, ...]:
    return (
        row.name,
        number(row.explained, ".1%"),
        number(first.gain - row.gain, ".3g"),
        number(row.significance, ".0f", "σ"),
        number(row.held_out_z, ".1f") if row is not first else MISSING,
    )


def step_tables(results: DiagnoseResults) -> list[Table]:
    """Names with value, standard error and share; the nearest one where the verdict is unknown."""
    found = _found(results)
    rows = [row for step in found for row in _step_rows(step)]
    title = "Found" if results.steps else "Nearest"
    return [
        *([Table(COLUMNS, rows, title, CAPTION)] if rows else []),
        *(_whole(step) for step in found if _long(step)),
    ]


def _rows(step: StepRow) -> list[Row]:
    return parameter_rows(step.shown or step.parameters, step.shown_sigma or step.sigma)


def _long(step: StepRow) -> bool:
    return len(_rows(step)) > MOST_ROWS


def _whole(step: StepRow) -> Table:
    """All values of a name that has many."""
    return Table(("parameter", "value", "unit"), _rows(step), f"All values of {step.effect}", folded=True)


def separation_tables(results: DiagnoseResults) -> list[Table]:
    """What would distinguish the names from others that fit as well."""
    rows = [
        (f"{step.effect} or {other.name}", other.reason, _what_separates(other))
        for step in results.steps
        for other in step.alternatives
    ]
    columns = ("effects", "why", "what distinguishes them")
    return [Table(columns, rows, "Not distinguished", prose=True)] if rows else []


def _found(results: DiagnoseResults) -> list[StepRow]:
    """Effects found, and the nearest where the verdict is unknown."""
    return [*results.steps, *([results.nearest] if results.nearest else [])]


def _step_rows(step: StepRow) -> list[tuple[str, ...]]:
    rows = _rows(step)
    head = (
        number(step.significance, ".1f", "σ"),
        number(step.explained, ".0%"),
        number(step.share, ".1%"),
        number(step.held_out_z, ".1f"),
        ", ".join(step.indistinguishable) or "–",
    )
    return [
        (
            step.effect if first else "",
            *row,
            *(head if first else [""] * len(head)),
        )
        for first, row in zip([True] + [False] * len(rows), shortened(rows), strict=False)
    ]


def _what_separates(other: Alternative) -> str:
    """What separates two effects, and the second recording in which they are least alike."""
    if not other.second_recording:
        return other.separated_by
    cosine = number(other.likeness_then, ".2f")
    return f"{other.separated_by}; a second recording {other.second_recording} (|cos| then {cosine})"


def ranking_bars(name: str, ranking: Sequence[Ranked]) -> Markup:
    """Draw what every candidate of a `ranking` explains, the best on top; `name` is unique in the page."""
    explained = np.nan_to_num([row.explained for row in ranking])
    rows = np.arange(len(ranking))

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        axes.barh(rows, np.clip(explained, 0, 1), 0.7, color=[BLUE, *[ORANGE] * (len(rows) - 1)])
        labels = [row.name for row in ranking]
        axes.set(yticks=rows, yticklabels=labels, ylim=(len(rows) - 0.4, -0.6), xlim=(0, 1))
        axes.set_xlabel("explained part of the excess")
        axes.grid(axis="y", visible=False)

    return svg(name, (WIDTH_IN, 0.7 + BAR_IN * len(ranking)), draw)
