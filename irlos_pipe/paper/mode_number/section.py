"""Section on the error against the number of estimated modes."""

from __future__ import annotations

from typing import Any

import numpy as np

from irlos_pipe.report.content import Figure, Section, Stack, Table
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_modes import error_plot
from irlos_pipe.report.text import number, plural

STAGE = "mode_number"
CALIBRATION = {"long_exposure": "this pipeline's default", "dip_global": "DIP global"}
LIFT = "lift_avg"
YLABEL = "Δ-WFE in Noll 2–30 [nm]"


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(STAGE)
    curves = results.get("curves", [])
    if not curves:
        return Section(STAGE, "Number of modes, simulated")
    mark = results["modes_introduced"] + 1
    blocks = [
        Figure(
            error_plot("number-calibration", results["highest_noll"], _calibration(curves), YLABEL, mark),
            "Calibration",
            f"Median over the cubes. Dotted: the introduced modes, Noll 2–{mark}.",
        ),
        Figure(
            error_plot("number-lift", results["highest_noll"], _of(curves, LIFT), YLABEL, mark),
            "LIFT avg.",
            "The mean image fitted without AO residual in the model, for stars of several magnitudes.",
        ),
        Stack([_table(curves), _recommended(results)]),
    ]
    return Section(STAGE, "Number of modes, simulated", _lead(results), blocks)


def _lead(results: dict[str, Any]) -> str:
    return (
        f"{plural(results.get('cubes', 0), 'cube')} with NCPAs of {results.get('modes_introduced')} modes, "
        "fitted with fewer and with more."
    )


def _calibration(curves: list[dict[str, Any]]) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    for method, text in CALIBRATION.items():
        found |= {f"{text}, {label}": values for label, values in _of(curves, method).items()}
    return found


def _of(curves: list[dict[str, Any]], method: str) -> dict[str, np.ndarray]:
    """Median errors of a method by magnitude."""
    return {
        f"m_J {one['mag_j']:g}": np.array(one["median_nm"], dtype=float)
        for one in curves
        if one["method"] == method
    }


def _table(curves: list[dict[str, Any]]) -> Table:
    names = CALIBRATION | {LIFT: "LIFT avg."}
    rows = [
        (
            names.get(one["method"], one["method"]),
            number(one["mag_j"], "g"),
            f"2–{one['best_noll']}",
            number(one["best_nm"]),
            f"{number(one['least_nm'][0])} … {number(one['worst_nm'][0])}",
            f"{number(one['least_nm'][-1])} … {number(one['worst_nm'][-1])}",
        )
        for one in curves
    ]
    columns = ("method", "m_J", "best modes", "error there [nm]", "fewest modes [nm]", "most modes [nm]")
    return Table(columns, rows, "Best number of modes", "Median over the cubes; least … worst cube.")


def _recommended(results: dict[str, Any]) -> Table:
    told = results["recommended_noll"]
    rows = [(f"2–{noll}", str(told.count(noll))) for noll in sorted(set(told))]
    caption = "What the misfit of frames that no fit has seen recommends to the default, without the truth."
    return Table(("modes", "cubes"), rows, "Recommended by unseen frames", caption)
