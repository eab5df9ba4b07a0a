"""Section on all methods with the same modes and frames."""

from __future__ import annotations

from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.paper.common.section import interval
from irlos_pipe.paper.ranking.results import RankingResults, RankingRow
from irlos_pipe.report.content import Block, Figure, Section, Table
from irlos_pipe.report.drawing import BLUE, GREEN, INK, ORANGE, PURPLE, SKY, svg
from irlos_pipe.report.run_data import RunData

STAGE = RankingResults.stage
COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, INK)
MODES = (
    "Error in Noll 2–30 [nm RMS], medians over the cubes with their range of 90 % by bootstrap over cubes, "
    "by the last fitted Noll mode. All methods have the same cubes and frames."
)
FRAMES = "The same with each method's own modes, by the number of frames, without a tail."


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(RankingResults)
    lead = (
        f"Cubes of {results.frames} frames; NCPAs as drawn {results.introduced_nm:.0f} ± "
        f"{results.introduced_scatter_nm:.0f} nm RMS, and a tail beyond Noll 51 where one is stated."
    )
    blocks: list[Block] = [Figure(_figure(results), "Error against modes", "Without a tail.", "full")]
    blocks.append(_table(results.rows, "modes", "Modes", MODES))
    with_parts = [row for row in results.rows if row.first]
    if with_parts:
        blocks.append(_table(with_parts, "first", "Frames", FRAMES))
    return Section(STAGE, "All methods with the same modes and frames", lead, blocks)


def _figure(results: RankingResults) -> Markup:
    seeings = list(dict.fromkeys(row.seeing_arcsec for row in results.rows))

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(1, len(seeings), sharey=True, squeeze=False)[0]
        for axes, seeing in zip(panels, seeings, strict=True):
            rows = [row for row in results.rows if row.seeing_arcsec == seeing and not row.tail_nm]
            for row, colour in zip(rows, COLOURS, strict=True):
                found = row.modes.values()
                medians = [one.value for one in found]
                reach = [[one.value - one.low for one in found], [one.high - one.value for one in found]]
                axes.errorbar(
                    list(row.modes), medians, reach, color=colour, marker="o", capsize=2, label=row.label
                )
            axes.set(title=f'{seeing:g}"', xlabel="last fitted Noll mode", yscale="log")
        panels[0].set_ylabel("error in Noll 2–30 [nm]")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)

    return svg("ranking", (9.0, 4.4), draw)


def _table(rows: list[RankingRow], part: str, title: str, caption: str) -> Table:
    names = list(dict.fromkeys(name for row in rows for name in getattr(row, part)))
    columns = ("seeing", "tail [nm]", "method", *names)
    body = [
        (
            f'{row.seeing_arcsec:g}"',
            f"{row.tail_nm:g}",
            row.label,
            *(interval(found[name]) if name in found else "–" for name in names),
        )
        for row in rows
        for found in [getattr(row, part)]
    ]
    return Table(columns, body, title, caption)
