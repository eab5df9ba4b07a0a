"""Section on simulated focus ramps, estimated with and without calibrated NCPAs."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import LogLocator, NullLocator

from irlos_pipe.conventions.modes import TIP_TILT
from irlos_pipe.paper.common.section import array_of, spread
from irlos_pipe.paper.focus_ramp.results import FocusRampResults, VariantRow
from irlos_pipe.report.content import Block, Figure, Section, Table
from irlos_pipe.report.drawing import BLUE, GREEN, INK, ORANGE, PURPLE, SKY, YELLOW, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import mode_label, plural

STAGE = FocusRampResults.stage
DRAWN = {  # the ramps drawn side by side, where they were run
    "none_9": "no NCPAs in the model",
    "published_9": "NCPAs by DIP global",
    "default_9": "this pipeline",
}
COLOURS = (BLUE, ORANGE, GREEN, PURPLE, SKY, YELLOW, INK)
KINDS = {"rms_nm": ("introduced", "o", ORANGE), "true_rms_nm": ("introduced + NCPA + AO residual", "s", BLUE)}
MODES_CAPTION = (
    "First ramp, nine modes, median per offset. Dashed: the true wavefront (introduced defocus, NCPAs, AO "
    "residual of each frame). NCPAs given to LIFT count as estimated; tip and tilt are not drawn."
)
ERROR_CAPTION = (
    "RMS of estimated minus introduced defocus of every ramp, and against the true defocus (introduced, "
    "NCPAs, mean AO residual of each frame; NCPAs given to LIFT count as estimated). Bars: medians."
)
COLUMNS = (
    "estimate",
    "modes",
    "slope",
    "offset [nm]",
    "error [nm RMS]",
    "about the line [nm RMS]",
    "against the true defocus [nm RMS]",
)


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(FocusRampResults)
    rows = results.ways
    errors = Figure(_errors(run, rows), "Error of every ramp", ERROR_CAPTION)
    blocks: list[Block] = [*_modes_figure(run, rows), errors, _table(rows)]
    return Section(STAGE, "Focus ramp with and without calibrated NCPAs", _lead(results), blocks)


def _lead(results: FocusRampResults) -> str:
    rows = {row.key: row for row in results.ways}
    errors = [
        f"{rows[key].true_rms_nm.median:.1f} nm {text}"
        for key, text in (
            ("none_9", "without NCPAs (nine modes)"),
            ("published_3", "with those of DIP global (three modes)"),
            ("default_3", "with this pipeline's (three modes)"),
        )
        if key in rows
    ]
    ramps = plural(results.samples, "ramp")
    return f"Median error against the defocus there was, over {ramps}: {', '.join(errors)}."


# -- one ramp, all modes -------------------------------------------------------------------------


def _modes_figure(run: RunData, rows: list[VariantRow]) -> list[Figure]:
    shown = [row for row in rows if row.key in DRAWN]
    if not shown:
        return []
    return [Figure(_modes(run, shown), "Estimated modes against introduced defocus", MODES_CAPTION, "full")]


def _modes(run: RunData, shown: list[VariantRow]) -> Markup:
    introduced, true = array_of(run, STAGE, "introduced_nm"), array_of(run, STAGE, "true_nm")

    def draw(figure: Canvas) -> None:
        top, bottom = figure.subplots(
            2, len(shown), sharex=True, sharey="row", squeeze=False, height_ratios=(3, 2)
        )
        for upper, lower, variant in zip(top, bottom, shown, strict=True):
            _draw_variant(
                upper, lower, variant, introduced, true, array_of(run, STAGE, f"{variant.key}/modes_nm")
            )
            upper.set_title(DRAWN[variant.key])
            lower.set_xlabel("introduced defocus [nm RMS]")
        top[0].set_ylabel("coefficient [nm RMS]")
        bottom[0].set_ylabel("estimated − true\n[nm RMS]")
        handles, labels = top[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4)

    return svg("focus-ramp-modes", (10.5, 6.2), draw)


def _draw_variant(
    upper: Axes, lower: Axes, variant: VariantRow, introduced: np.ndarray, true: np.ndarray, modes: np.ndarray
) -> None:
    """Estimated and true coefficients above, their difference below."""
    drawn = [noll for noll in variant.modes if noll not in TIP_TILT]
    lower.axhline(0, color=INK, linewidth=0.9)
    for noll, colour in zip(drawn, COLOURS, strict=False):
        estimated, there = modes[:, variant.modes.index(noll)], true[:, noll - 2]
        offsets, median = _medians(introduced, estimated)
        upper.plot(offsets, median, "o-", color=colour, markersize=3, label=mode_label(noll))
        upper.plot(offsets, _medians(introduced, there)[1], "--", color=colour, linewidth=0.9)
        lower.plot(offsets, _medians(introduced, estimated - there)[1], "o-", color=colour, markersize=3)


def _medians(introduced: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offsets and the median of their frames."""
    offsets = np.unique(introduced)
    return offsets, np.array([np.nanmedian(values[introduced == offset]) for offset in offsets])


# -- all ramps -----------------------------------------------------------------------------------


def _errors(run: RunData, rows: list[VariantRow]) -> Markup:
    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        for place, row in enumerate(rows[::-1]):
            for shift, (key, look) in zip((0.17, -0.17), KINDS.items(), strict=True):
                values = array_of(run, STAGE, f"{row.key}/{key}")
                _draw_samples(axes, values, place + shift, look, labelled=place == 0)
        axes.set_yticks(range(len(rows)), [_name(row) for row in rows[::-1]])
        axes.set(xlabel="error of the defocus [nm RMS]", xscale="log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_locator(NullLocator())
        figure.legend(loc="outside upper center", ncols=2)

    return svg("focus-ramp-errors", (5.4, 0.8 + 0.42 * len(rows)), draw)


def _draw_samples(axes: Axes, values: np.ndarray, row: float, look: tuple, labelled: bool) -> None:
    label, marker, colour = look
    height = np.full(len(values), row)
    label = label if labelled else None
    axes.plot(values, height, marker, color=colour, markersize=3.5, alpha=0.7, label=label)
    axes.vlines(np.median(values), row - 0.15, row + 0.15, color=INK, linewidth=1.4)


def _name(row: VariantRow) -> str:
    """Label of a variant on two lines."""
    first, _, rest = row.label.partition(", ")
    return f"{first},\n{rest}, {len(row.modes)} modes"


def _table(rows: list[VariantRow]) -> Table:
    body = [
        (
            row.label,
            str(len(row.modes)),
            spread(row.slope, ".3f"),
            spread(row.offset_nm, "+.1f"),
            spread(row.rms_nm),
            spread(row.line_rms_nm),
            spread(row.true_rms_nm),
        )
        for row in rows
    ]
    marks = ["good" if row.label.startswith("default:") else "" for row in rows]
    caption = "Medians over the ramps, 16th to 84th percentile in brackets."
    return Table(COLUMNS, body, "Variants of LIFT", caption, marks)
