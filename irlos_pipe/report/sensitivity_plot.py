"""Error and failures against magnitude: a drawing, and words for the limiting magnitude."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from irlos_pipe.estimate.sensitivity import MEDIAN_OF_NORMAL
from irlos_pipe.report.drawing import CYCLE, INK, log_y, svg
from irlos_pipe.report.text import MISSING, number

MARKERS = ("o", "s", "^", "D", "v", "P")


@dataclass(frozen=True)
class Look:
    """How a curve is drawn; only a `main` one has its spread, its bound and its limit drawn too."""

    colour: str
    marker: str
    main: bool = True


LOOKS = tuple(Look(colour, marker) for colour, marker in zip(CYCLE, MARKERS, strict=True))


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

    @classmethod
    def of(cls, row: dict[str, Any], label: str) -> Curve:
        """Curve from its entry in results.json."""

        def values(key: str) -> np.ndarray:
            found = row.get(key)
            return np.array(found, dtype=float) if found else np.full(len(row.get("mag_j", [])), np.nan)

        return cls(
            label,
            values("mag_j"),
            values("median_abs_error_nm"),
            values("p16_nm"),
            values("p84_nm"),
            values("crb_nm"),
            values("failures") / (row.get("trials") or np.nan),
            row.get("limit_mag"),
        )


def limit_text(row: dict[str, Any]) -> str:
    """Limiting magnitude of a curve; with ``≥`` where the grid ends before the criterion is missed."""
    limit, grid = row.get("limit_mag"), row.get("mag_j") or [None]
    at_the_end = limit is not None and limit == grid[-1]
    return ("≥ " if at_the_end else "") + number(limit)


def criterion_text(criterion: dict[str, Any]) -> str:
    """What a limiting magnitude means."""
    error = number(criterion.get("median_abs_error_nm"), ".0f", "nm")
    failures = number(criterion.get("failures"), ".0%")
    return (
        f"Faintest magnitude with median |error| ≤ {error} and ≤ {failures} failures; "
        f"≥: the magnitudes end before. {MISSING}: met at no magnitude."
    )


def sensitivity_plot(
    name: str,
    curves: Sequence[Curve],
    criterion: dict[str, Any],
    looks: Sequence[Look] = LOOKS,
    floor_nm: float | None = None,
) -> Markup:
    """Draw median errors above and failures below.

    Parameters
    ----------
    name : str
        Unique in the page.
    floor_nm : float, optional
        Median error of a perfect sensor.
    """

    def draw(figure: Canvas) -> None:
        top, bottom = figure.subplots(2, sharex=True, height_ratios=(3, 1))
        for place, curve in enumerate(curves):
            look = looks[place % len(looks)]
            _draw_errors(top, curve, look)
            bottom.plot(curve.mag_j, 100 * curve.failed, f"{look.marker}-", color=look.colour, markersize=3.5)
        _draw_level(top, floor_nm, 1, ":", "AO residual's own defocus")
        _draw_level(top, criterion.get("median_abs_error_nm"), 1, "-.")
        _draw_level(bottom, criterion.get("failures"), 100, "-.")
        top.set_ylabel("median |error| [nm RMS]")
        log_y(top, *(curve.median_nm for curve in curves))
        figure.legend(loc="outside upper center", ncols=2)
        bottom.set(xlabel="J magnitude", ylabel="failures [%]")
        bottom.set_ylim(bottom=-2)

    return svg(name, (5.2, 4.8), draw)


def _draw_errors(axes: Axes, curve: Curve, look: Look) -> None:
    axes.plot(
        curve.mag_j,
        curve.median_nm,
        f"{look.marker}-",
        color=look.colour,
        markersize=3.5,
        linewidth=1.4 if look.main else 0.8,
        label=curve.label,
    )
    if look.main:
        axes.fill_between(curve.mag_j, curve.p16_nm, curve.p84_nm, color=look.colour, alpha=0.15, linewidth=0)
        axes.plot(curve.mag_j, MEDIAN_OF_NORMAL * curve.crb_nm, "--", color=look.colour, linewidth=0.9)
    if look.main and curve.limit_mag is not None:
        axes.axvline(curve.limit_mag, color=look.colour, linewidth=0.8, linestyle=":")


def _draw_level(axes: Axes, level: float | None, factor: float, style: str, label: str | None = None) -> None:
    if level is not None:
        axes.axhline(factor * level, color=INK, linewidth=0.8, linestyle=style, label=label)
