"""Section on calibrations beside petals out of step."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.paper.common.section import mark, spread
from irlos_pipe.paper.low_wind.results import LowWindResults, LowWindRow
from irlos_pipe.report.content import Block, Figure, Section, Table
from irlos_pipe.report.drawing import BLUE, GREEN, INK, ORANGE, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number, plural

STAGE = LowWindResults.stage
COLOURS = (BLUE, GREEN, ORANGE)
LINES = {"without": ("--", "o"), "with": ("-", "s")}
COLUMNS = (
    "cube",
    "pistons [nm RMS]",
    "largest difference [nm]",
    "petals in the model",
    "left [nm RMS]",
    "left, whole waves apart [nm RMS]",
    "left in Noll 2–30 [nm RMS]",
    "χ²/ν",
)
CAPTION = (
    "RMS over the pupil of the true minus the estimated wavefront, medians over the samples, 16th to 84th "
    "percentile in brackets. Whole waves apart: every petal may be off by whole waves of H, which one narrow "
    "band cannot show."
)
FIGURE_CAPTION = "Medians, whole waves of H of a petal apart. Dashed: no petals in the model."


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(LowWindResults)
    figure = Figure(_figure(results.rows), "What is left of the wavefront", FIGURE_CAPTION)
    blocks: list[Block] = [figure, _table(results.rows)]
    return Section(STAGE, "Low-wind effect: petals out of step", _lead(results), blocks)


def _lead(results: LowWindResults) -> str:
    asked = [row for row in results.rows if np.isfinite(row.asked_nm)]
    kept = sum(row.worst_nm <= row.asked_nm for row in asked)
    return (
        f"{plural(results.samples, 'pattern')} of petals: with petals in the model every cube is within "
        f"{asked[0].asked_nm:g} nm in {kept} of {len(asked)} kinds of cubes."
    )


def _figure(rows: list[LowWindRow]) -> Markup:
    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        recordings = list(dict.fromkeys(row.recording for row in rows))
        for recording, colour in zip(recordings, COLOURS, strict=False):
            for model, (line, marker) in LINES.items():
                of_it = [row for row in rows if (row.recording, row.model) == (recording, model)]
                sizes_nm, left_nm = _columns(of_it)
                label = f"{recording}, {model}"
                axes.plot(sizes_nm, left_nm, marker + line, color=colour, markersize=4, label=label)
        for asked_nm in {row.asked_nm for row in rows if np.isfinite(row.asked_nm)}:
            axes.axhline(asked_nm, color=INK, linestyle=":", linewidth=0.9)
        axes.set(xlabel="pistons [nm RMS over the petals]", ylabel="left [nm RMS]", yscale="log")
        figure.legend(loc="outside upper center", ncols=2)

    return svg("low-wind-left", (5.4, 4.6), draw)


def _columns(rows: list[LowWindRow]) -> tuple[list[float], list[float]]:
    return [row.size_nm for row in rows], [row.folded_nm.median for row in rows]


def _table(rows: list[LowWindRow]) -> Table:
    body = [
        (
            row.recording,
            number(row.size_nm, "g"),
            number(row.largest_difference_nm.median, ".0f"),
            {"with": "yes", "without": "no"}[row.model],
            spread(row.pupil_nm),
            spread(row.folded_nm),
            spread(row.modes_nm),
            number(row.chi2_nu.median, ".1f"),
        )
        for row in rows
    ]
    marks = [mark(row.worst_nm, row.asked_nm) for row in rows]
    return Table(COLUMNS, body, "Sizes of the effect", CAPTION, marks)
