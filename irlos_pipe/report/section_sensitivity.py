"""Section on the sensitivity: error and failures against magnitude."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.estimate.sensitivity import MEDIAN_OF_NORMAL
from irlos_pipe.report.content import Figure, Section, Stack, Table
from irlos_pipe.report.drawing import CYCLE, INK, log_y, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import MISSING, number

STAGE = "sensitivity"
MARKERS = ("o", "s", "^", "D", "v", "P")
CAPTION = (
    f"Bands: 16th to 84th percentile. Dashed: Cramér–Rao bound times {MEDIAN_OF_NORMAL}, the median "
    "|error| of an efficient estimate. Horizontal and vertical lines: criterion and limiting magnitudes."
)
COLUMNS = ("NCPAs", "modes", "limit [J mag]", "error at the bright end [nm]")


@dataclass(frozen=True)
class Curve:
    """One curve as arrays over magnitude; NaN where a value is missing."""

    label: str
    mag_j: np.ndarray
    median_nm: np.ndarray
    p16_nm: np.ndarray
    p84_nm: np.ndarray
    crb_nm: np.ndarray
    failed: np.ndarray
    limit_mag: float | None


def sensitivity_section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(STAGE)
    curves = [_curve(row) for row in results.get("curves", [])]
    blocks = []
    if curves:
        blocks = [
            Figure(_plot(curves, results.get("criterion") or {}), "Defocus error against magnitude", CAPTION),
            Stack(
                [
                    Table(
                        COLUMNS,
                        [_row(row) for row in results["curves"]],
                        "Limiting magnitude",
                        _criterion(results),
                    )
                ]
            ),
        ]
    return Section(STAGE, "Sensitivity", _lead(results), blocks)


def limit_text(row: dict[str, Any]) -> str:
    """Limiting magnitude of a curve; with ``≥`` where the grid ends before the criterion is missed."""
    limit, grid = row.get("limit_mag"), row.get("mag_j") or [None]
    at_the_end = limit is not None and limit == grid[-1]
    return ("≥ " if at_the_end else "") + number(limit)


def _lead(results: dict[str, Any]) -> str:
    trials = {row.get("trials") for row in results.get("curves", [])} - {None}
    return f"Frames dimmed to fainter stars, {max(trials)} estimates per magnitude." if trials else ""


def _criterion(results: dict[str, Any]) -> str:
    criterion = results.get("criterion") or {}
    error = number(criterion.get("median_abs_error_nm"), ".0f", "nm")
    failures = number(criterion.get("failures"), ".0%")
    return (
        f"Faintest magnitude with median |error| ≤ {error} and ≤ {failures} failures; "
        f"≥: the magnitudes end before. {MISSING}: met at no magnitude."
    )


def _row(row: dict[str, Any]) -> tuple[str, ...]:
    curve = _curve(row)
    return (
        "added" if row.get("calibrated") else "left out",
        ", ".join(map(str, row.get("modes", []))),
        limit_text(row),
        number(curve.median_nm[0]) if curve.median_nm.size else MISSING,
    )


def _curve(row: dict[str, Any]) -> Curve:
    def values(key: str) -> np.ndarray:
        found = row.get(key)
        return np.array(found, dtype=float) if found else np.full(len(row.get("mag_j", [])), np.nan)

    label = f"{'with' if row.get('calibrated') else 'without'} NCPAs, {len(row.get('modes', []))} modes"
    return Curve(
        label,
        values("mag_j"),
        values("median_abs_error_nm"),
        values("p16_nm"),
        values("p84_nm"),
        values("crb_nm"),
        values("failures") / (row.get("trials") or np.nan),
        row.get("limit_mag"),
    )


def _plot(curves: list[Curve], criterion: dict[str, Any]) -> Markup:
    def draw(figure: Canvas) -> None:
        top, bottom = figure.subplots(2, sharex=True, height_ratios=(3, 1))
        for place, curve in enumerate(curves):
            colour, marker = CYCLE[place % len(CYCLE)], MARKERS[place % len(MARKERS)]
            _draw_errors(top, curve, colour, marker)
            bottom.plot(curve.mag_j, 100 * curve.failed, f"{marker}-", color=colour, markersize=3.5)
        _draw_limit(top, criterion.get("median_abs_error_nm"), 1)
        _draw_limit(bottom, criterion.get("failures"), 100)
        top.set_ylabel("median |error| [nm RMS]")
        log_y(top, *(curve.median_nm for curve in curves))
        figure.legend(loc="outside upper center", ncols=2)
        bottom.set(xlabel="J magnitude", ylabel="failures [%]")
        bottom.set_ylim(bottom=-2)

    return svg("sensitivity", (5.2, 4.8), draw)


def _draw_errors(axes: Axes, curve: Curve, colour: str, marker: str) -> None:
    axes.fill_between(curve.mag_j, curve.p16_nm, curve.p84_nm, color=colour, alpha=0.15, linewidth=0)
    axes.plot(curve.mag_j, curve.median_nm, f"{marker}-", color=colour, markersize=3.5, label=curve.label)
    axes.plot(curve.mag_j, MEDIAN_OF_NORMAL * curve.crb_nm, "--", color=colour, linewidth=0.9)
    if curve.limit_mag is not None:
        axes.axvline(curve.limit_mag, color=colour, linewidth=0.8, linestyle=":")


def _draw_limit(axes: Axes, limit: float | None, factor: float) -> None:
    if limit is not None:
        axes.axhline(factor * limit, color=INK, linewidth=0.8, linestyle="-.")
