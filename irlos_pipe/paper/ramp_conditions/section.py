"""Section on calibrated ramps whose light has what their calibration could not show."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from irlos_pipe.conventions.modes import TIP_TILT
from irlos_pipe.paper.common.section import array_of, interval, mark
from irlos_pipe.paper.ramp_conditions.conditions import ASKED_NM
from irlos_pipe.paper.ramp_conditions.results import RampConditionsResults, WayRow
from irlos_pipe.report.content import Block, Figure, Section, Table
from irlos_pipe.report.drawing import BLUE, INK, ORANGE, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import mode_label, number, plural

STAGE = RampConditionsResults.stage
MODES_OF = (  # condition and way whose modes are listed
    ("clean", "nine"),
    ("clean", "nine_astigmatism"),
    ("clean", "uncalibrated_nine"),
    ("narrow_h", "plain_nine"),
    ("narrow_h", "uncalibrated_nine"),
)
COLUMNS = (
    "in the light of the ramp",
    "estimate",
    "error [nm RMS]",
    "mean of a ramp [nm RMS]",
    "against the introduced defocus [nm RMS]",
)
CAPTION = (
    "Error of the defocus against the one there was in every frame (introduced, NCPAs and AO residual, at "
    "the wavelength of the calibration), RMS over all frames of all ramps; ranges of 90 % by bootstrap over "
    "the ramps."
)
MODE_COLUMNS = (
    "ramp",
    "mode",
    "error [nm RMS]",
    "quoted, photon noise [nm]",
    "scatter [nm RMS]",
    "scatter there was [nm RMS]",
    "of the introduced defocus",
)
MODE_CAPTION = (
    "Scatter over the frames of a ramp, beside what goes with the introduced defocus, of the estimate and of "
    "the mode there was; last column: the part of the introduced defocus that goes into the mode, of defocus "
    "itself slope minus 1."
)
FIGURE_CAPTION = (
    "Every point is a ramp; bars: RMS over the ramps; dotted: what is asked of the first estimate."
)


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(RampConditionsResults)
    figure = Figure(_errors(run, results.rows), "Error of the defocus of every ramp", FIGURE_CAPTION, "full")
    blocks: list[Block] = [figure, _table(results.rows), *_modes(results.rows)]
    return Section(STAGE, "Ramps with colours, filters and dispersion", _lead(results), blocks)


def _lead(results: RampConditionsResults) -> str:
    asked = [row for row in results.rows if np.isfinite(row.asked_nm)]
    kept = sum(row.true_rms_nm.value <= row.asked_nm for row in asked)
    return (
        f"{plural(results.samples, 'set')} of NCPAs, calibrated in narrow H by the mirror: the error of the "
        f"defocus is within {ASKED_NM:g} nm under {kept} of {len(asked)} conditions."
    )


def _errors(run: RunData, rows: list[WayRow]) -> Markup:
    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        for place, row in enumerate(rows[::-1]):
            values = array_of(run, STAGE, f"{row.condition}/{row.way}/true_rms_nm")
            colour = BLUE if np.isfinite(row.asked_nm) else ORANGE
            axes.plot(values, np.full(len(values), place), "o", color=colour, markersize=3.5, alpha=0.7)
            axes.vlines(row.true_rms_nm.value, place - 0.25, place + 0.25, color=INK, linewidth=1.4)
        axes.axvline(ASKED_NM, color=INK, linestyle=":", linewidth=0.9)
        axes.set_yticks(range(len(rows)), [f"{row.condition_label}; {row.label}" for row in rows[::-1]])
        axes.set(xlabel="error of the defocus [nm RMS]", xscale="log")

    return svg("ramp-conditions-errors", (10.5, 0.8 + 0.24 * len(rows)), draw)


def _table(rows: list[WayRow]) -> Table:
    body = [
        (
            row.condition_label,
            row.label,
            interval(row.true_rms_nm),
            interval(row.bias_nm),
            interval(row.rms_nm),
        )
        for row in rows
    ]
    marks = [mark(row.true_rms_nm.value, row.asked_nm) for row in rows]
    return Table(COLUMNS, body, "Conditions and estimates", CAPTION, marks)


def _modes(rows: list[WayRow]) -> list[Table]:
    listed = [row for row in rows if (row.condition, row.way) in MODES_OF]
    body = [
        (
            f"{row.condition_label}; {row.label}",
            mode_label(mode.noll),
            interval(mode.error_nm),
            number(mode.sigma_nm, ".2f"),
            number(mode.scatter_nm, ".1f"),
            number(mode.true_scatter_nm, ".1f"),
            number(mode.leak, ".4f"),
        )
        for row in listed
        for mode in row.modes
        if mode.noll not in TIP_TILT
    ]
    return [Table(MODE_COLUMNS, body, "All modes of a ramp", MODE_CAPTION)] if body else []
