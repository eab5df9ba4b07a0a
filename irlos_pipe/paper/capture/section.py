"""Section on the capture range: from how far LIFT finds the defocus of a simulated frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.paper.capture.results import CaptureResults, StartRow
from irlos_pipe.paper.common.section import array_of
from irlos_pipe.report.content import Block, Figure, Section, Stack, Table
from irlos_pipe.report.drawing import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number

STAGE = CaptureResults.stage
NAMES = {
    "zero": "zero (paper)",
    "elongation": "elongation prior",
    "scan": "scan of defocus",
    "default": "this pipeline's default",
}
LOOKS = {
    "zero": (ORANGE, "^", "--"),
    "elongation": (GREEN, "s", "-."),
    "scan": (PURPLE, "D", ":"),
    "default": (BLUE, "o", "-"),
}
GUESSED, SOLVED = ("elongation", "scan"), ("zero", "default")
TITLES = ("Where the iteration starts", "Where it ends")
COLUMNS = (
    "start",
    "captured",
    "wrong",
    "flagged",
    "all captured within [nm]",
    "error of the captured [nm RMS]",
    "largest error of these [nm]",
    "smallest wrong error [nm]",
)
SUCCESS_CAPTION = (
    "Frames whose defocus is found, in bins of true defocus. Dotted: capture range the paper states for a "
    "start from zero; dash-dotted: range asked for."
)
START_CAPTION = (
    "An image is longest where the defocus is the astigmatism over √2, 120 nm; further out its elongation "
    "fades and gives the sign only. The scan compares it with the model's images from −700 to 700 nm."
)
ESTIMATE_CAPTION = (
    "Every point is a frame with pointing, AO residual and noise of its own. Most wrong estimates lie near "
    "the opposite defocus, whose image is the most similar one."
)


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(CaptureResults)
    starts = _against_truth(run, results, "start_nm", GUESSED, "start")
    estimates = _against_truth(run, results, "defocus_nm", SOLVED, "estimate")
    blocks: list[Block] = [
        Figure(_success(results), "Success against defocus", SUCCESS_CAPTION, "half"),
        Stack([Figure(starts, TITLES[0], START_CAPTION), Figure(estimates, TITLES[1], ESTIMATE_CAPTION)]),
        _table(results),
        *([_table_in_h(results)] if results.h_starts else []),
    ]
    return Section(STAGE, "Capture range of LIFT", _lead(results), blocks)


def _lead(results: CaptureResults) -> str:
    inside = next(row.required for row in results.starts if row.start == "default")
    return (
        f"m_J {results.mag_j:g}, J and H, 1 s: within ±{results.required_nm:.0f} nm RMS the default "
        f"finds {inside.captured} of {inside.cases} random cases, {inside.wrong} wrong."
    )


def _table(results: CaptureResults) -> Table:
    rows = results.starts
    caption = (
        f"First columns: cases within ±{results.required_nm:.0f} nm; the others: all {results.cases}. "
        f"Captured: converged, and within {results.wrong_limit_nm:.0f} nm of the truth. Wrong: converged "
        "elsewhere. Flagged: not converged, and says so. ≥: no case was missed."
    )
    return Table(COLUMNS, [_row(row) for row in rows], "Starts compared", caption, _marks(rows))


def _table_in_h(results: CaptureResults) -> Table:
    rows = results.h_starts
    caption = (
        f"The same with light in H alone, {results.h_cases} cases, their NCPAs known exactly: for H the "
        f"paper states ±{results.paper_nm:.0f} nm from zero."
    )
    return Table(COLUMNS, [_row(row) for row in rows], "Starts compared in H", caption, _marks(rows))


def _marks(rows: Sequence[StartRow]) -> list[str]:
    return ["good" if row.required.captured == row.required.cases else "bad" for row in rows]


def _row(row: StartRow) -> tuple[str, ...]:
    inside, everything = row.required, row.all
    none_missed = everything.captured == everything.cases
    return (
        NAMES.get(row.start, row.start),
        f"{inside.captured} of {inside.cases}",
        str(inside.wrong),
        str(inside.flagged),
        ("≥ " if none_missed else "") + number(row.range_nm, ".0f"),
        number(row.rms_nm),
        number(row.largest_right_nm),
        number(row.smallest_wrong_nm, ".0f"),
    )


def _success(results: CaptureResults) -> Markup:
    edges = np.array(results.bin_edges_nm)
    centres = (edges[1:] + edges[:-1]) / 2

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        _draw_ranges(axes, results)
        for row in results.starts:
            colour, marker, line = LOOKS[row.start]
            cases = np.maximum(row.cases_per_bin, 1)
            part = np.where(np.array(row.cases_per_bin) > 0, np.array(row.captured_per_bin) / cases, np.nan)
            axes.plot(
                centres, 100 * part, line, marker=marker, markersize=4, color=colour, label=NAMES[row.start]
            )
        axes.set(xlabel="true defocus [nm RMS]", ylabel="captured [%]", ylim=(-3, 103))
        figure.legend(loc="outside upper center", ncols=2)

    return svg("capture-success", (5.2, 5.6), draw)


def _draw_ranges(axes: Axes, results: CaptureResults) -> None:
    for size, line in ((results.paper_nm, ":"), (results.required_nm, "-.")):
        for side in (-size, size):
            axes.axvline(side, color=INK, linewidth=0.8, linestyle=line)


def _against_truth(
    run: RunData, results: CaptureResults, quantity: str, starts: tuple[str, ...], label: str
) -> Markup:
    """One panel per start; what lies beyond is drawn at the edge."""
    true = array_of(run, STAGE, "true_nm")
    reach = 1.1 * max(abs(edge) for edge in results.bin_edges_nm)

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(1, len(starts), sharex=True, sharey=True)
        for axes, name in zip(panels, starts, strict=True):
            values = np.clip(array_of(run, STAGE, f"{name}/{quantity}"), -reach, reach)
            axes.plot((-reach, reach), (-reach, reach), color=FAINT, linewidth=0.8)
            axes.plot(true, values, ".", color=LOOKS[name][0], markersize=2.5)
            axes.set(title=NAMES[name], xlabel="true [nm RMS]", aspect="equal")
        panels[0].set_ylabel(f"{label} [nm RMS]")

    return svg(f"capture-{label}", (5.2, 2.75), draw)
