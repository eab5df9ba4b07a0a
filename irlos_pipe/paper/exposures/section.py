"""Section on calibration methods against the length of an exposure."""

from __future__ import annotations

from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.paper.common.section import spread
from irlos_pipe.paper.exposures.results import ExposuresResults
from irlos_pipe.report.content import Block, Figure, Section, Table
from irlos_pipe.report.drawing import BLUE, GREEN, INK, ORANGE, PURPLE, SKY, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import plural

STAGE = ExposuresResults.stage
COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, INK)
CAPTION = (
    "Δ-WFE in Noll 2–30 against the mean wavefront [nm RMS], medians over the cubes, 16th to 84th percentile "
    "in brackets. All exposures of a cube are sums of the same short ones, so they have the same light."
)


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(ExposuresResults)
    figure = Figure(_figure(results), "Error against exposure", "Medians over the cubes.", "full")
    blocks: list[Block] = [figure, _table(results)]
    lead = f"{plural(results.cubes, 'cube')} at each seeing, {results.total_s:g} s of light in each."
    return Section(STAGE, "Length of an exposure", lead, blocks)


def _figure(results: ExposuresResults) -> Markup:
    seeings = list(dict.fromkeys(row.seeing_arcsec for row in results.rows))

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(1, len(seeings), sharey=True, squeeze=False)[0]
        for axes, seeing in zip(panels, seeings, strict=True):
            rows = [row for row in results.rows if row.seeing_arcsec == seeing]
            for row, colour in zip(rows, COLOURS, strict=False):
                medians = [one.median for one in row.modes_nm]
                axes.plot(results.exposures_s, medians, "o-", color=colour, markersize=4, label=row.label)
            axes.set(title=f'{seeing:g}"', xlabel="exposure [s]", xscale="log", yscale="log")
        panels[0].set_ylabel("Δ-WFE in Noll 2–30 [nm]")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)

    return svg("exposures", (9.0, 4.4), draw)


def _table(results: ExposuresResults) -> Table:
    columns = ("seeing", "method", *(f"{one:g} s" for one in results.exposures_s))
    body = [
        (f'{row.seeing_arcsec:g}"', row.label, *(spread(one) for one in row.modes_nm)) for row in results.rows
    ]
    return Table(columns, body, "Exposures", CAPTION)
