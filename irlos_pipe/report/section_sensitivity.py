"""Section on the sensitivity: error and failures against magnitude."""

from __future__ import annotations

from typing import Any

from irlos_pipe.estimate.sensitivity import MEDIAN_OF_NORMAL
from irlos_pipe.report.content import Figure, Section, Stack, Table
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.sensitivity_plot import Curve, criterion_text, limit_text, sensitivity_plot
from irlos_pipe.report.text import MISSING, number

STAGE = "sensitivity"
CAPTION = (
    f"Bands: 16th to 84th percentile. Dashed: Cramér–Rao bound times {MEDIAN_OF_NORMAL}, the median "
    "|error| of an efficient estimate. Horizontal and vertical lines: criterion and limiting magnitudes."
)
COLUMNS = ("NCPAs", "modes", "limit [J mag]", "error at the bright end [nm]")


def sensitivity_section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(STAGE)
    rows, criterion = results.get("curves", []), results.get("criterion") or {}
    curves = [Curve.of(row, _label(row)) for row in rows]
    blocks = []
    if curves:
        drawing = sensitivity_plot("sensitivity", curves, criterion)
        limits = Table(COLUMNS, [_row(row) for row in rows], "Limiting magnitude", criterion_text(criterion))
        blocks = [Figure(drawing, "Defocus error against magnitude", CAPTION), Stack([limits])]
    return Section(STAGE, "Sensitivity", _lead(results), blocks)


def _lead(results: dict[str, Any]) -> str:
    trials = {row.get("trials") for row in results.get("curves", [])} - {None}
    return f"Frames dimmed to fainter stars, {max(trials)} estimates per magnitude." if trials else ""


def _label(row: dict[str, Any]) -> str:
    return f"{'with' if row.get('calibrated') else 'without'} NCPAs, {len(row.get('modes', []))} modes"


def _row(row: dict[str, Any]) -> tuple[str, ...]:
    median_nm = Curve.of(row, "").median_nm
    return (
        "added" if row.get("calibrated") else "left out",
        ", ".join(map(str, row.get("modes", []))),
        limit_text(row),
        number(median_nm[0]) if median_nm.size else MISSING,
    )
