"""Section on the error against the number of estimated modes."""

from __future__ import annotations

import numpy as np

from irlos_pipe.paper.common.variants import DEFAULT, METHOD_NAMES, PAPER_CHOICE
from irlos_pipe.paper.mode_number.experiment import LIFT
from irlos_pipe.paper.mode_number.results import ModeNumberResults, NumberCurve
from irlos_pipe.report.content import Block, Figure, Section, Stack, Table
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_modes import error_plot
from irlos_pipe.report.text import number, plural

STAGE = ModeNumberResults.stage
YLABEL = "Δ-WFE in Noll 2–30 [nm]"


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(ModeNumberResults)
    curves, numbers, last = results.curves, results.highest_noll, results.modes_introduced + 1
    calibration = {
        f"{METHOD_NAMES[method]}, {label}": values
        for method in (DEFAULT, PAPER_CHOICE)
        for label, values in _of(curves, method).items()
    }
    blocks: list[Block] = [
        Figure(
            error_plot("number-calibration", numbers, calibration, YLABEL, last),
            "Calibration",
            f"Median over the cubes. Dotted: the introduced modes, Noll 2–{last}.",
        ),
        Figure(
            error_plot("number-lift", numbers, _of(curves, LIFT), YLABEL, last),
            METHOD_NAMES[LIFT],
            "The mean image fitted without AO residual in the model, for stars of several magnitudes.",
        ),
        Stack([_table(curves), _recommended(results)]),
    ]
    lead = (
        f"{plural(results.cubes, 'cube')} with NCPAs of {results.modes_introduced} modes, "
        "fitted with fewer and with more."
    )
    return Section(STAGE, "Number of modes, simulated", lead, blocks)


def _of(curves: list[NumberCurve], method: str) -> dict[str, np.ndarray]:
    """Median errors of a method by magnitude."""
    return {f"m_J {one.mag_j:g}": np.array(one.median_nm) for one in curves if one.method == method}


def _table(curves: list[NumberCurve]) -> Table:
    rows = [
        (
            METHOD_NAMES[one.method],
            number(one.mag_j, "g"),
            f"2–{one.best_noll}",
            number(one.best_nm),
            f"{number(one.least_nm[0])} … {number(one.worst_nm[0])}",
            f"{number(one.least_nm[-1])} … {number(one.worst_nm[-1])}",
        )
        for one in curves
    ]
    columns = ("method", "m_J", "best modes", "error there [nm]", "fewest modes [nm]", "most modes [nm]")
    return Table(columns, rows, "Best number of modes", "Median over the cubes; least … worst cube.")


def _recommended(results: ModeNumberResults) -> Table:
    found = results.recommended_noll
    rows = [(f"2–{noll}", str(found.count(noll))) for noll in sorted(set(found))]
    caption = "What the misfit of frames that no fit has seen recommends to the default, without the truth."
    return Table(("modes", "cubes"), rows, "Recommended by unseen frames", caption)
