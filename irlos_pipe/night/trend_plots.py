"""Drawings of a trend: numbers against time with their bands, and the structure function of the NCPAs."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import matplotlib
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure, SubFigure

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.files.atomic import atomic_file
from irlos_pipe.night.stability import DAY_S, Structure
from irlos_pipe.night.trend import Series, Trend
from irlos_pipe.report.drawing import BLUE, CYCLE, ORANGE, SKY, STYLE, svg

WIDTH_IN, PANEL_IN = 5.6, 0.95
UNITS = ("nm", "arcsec", "mas")
SPELT = {"noll": "Noll", "ncpa": "NCPAs", "ao": "AO"}
MOST_PANELS = 16
FORMATS = (".svg", ".png", ".pdf")


def series_drawing(name: str, shown: Sequence[Series]) -> Markup:
    """Draw numbers against time, one below the other, as SVG for a page."""
    return svg(name, (WIDTH_IN, 0.6 + PANEL_IN * len(shown)), lambda figure: draw_series(figure, shown))


def structure_drawing(name: str, trend: Trend) -> Markup:
    """Draw the structure functions as SVG for a page."""
    return svg(name, (WIDTH_IN, 3.2), lambda figure: draw_structures(figure, trend))


def save_plot(trend: Trend, path: Path) -> None:
    """Write numbers against time, up to `MOST_PANELS` of them, and structure functions to a file.

    Raises
    ------
    ConfigurationError
        When the ending of the name is of no kind of file that can be written.
    IrlosError
        When it cannot be written.
    """
    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise ConfigurationError(f"--plot {path}: give a name that ends in {', '.join(FORMATS)}")
    shown = trend.series[:MOST_PANELS]
    heights = (0.6 + PANEL_IN * len(shown), 3.2 if trend.structures else 0.0)
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(STYLE | {"figure.facecolor": "white"})
        figure = Figure(figsize=(1.3 * WIDTH_IN, sum(heights)))
        if trend.structures:
            upper, lower = figure.subfigures(2, height_ratios=heights)
            draw_structures(lower, trend)
        else:
            upper = figure
        draw_series(upper, shown)
        with atomic_file(path) as stream:
            figure.savefig(stream, format=kind[1:], dpi=150)


def draw_series(figure: Figure | SubFigure, shown: Sequence[Series]) -> None:
    """Fill a figure with one panel per series, over a common time axis."""
    stack = figure.subplots(len(shown), sharex=True, squeeze=False)[:, 0]
    names = [series.name for series in shown]
    for axes, series in zip(stack, shown, strict=True):
        _panel(axes, series)
        owner = f"  ({series.recipe}, {series.configuration})" if names.count(series.name) > 1 else ""
        axes.set_title(label(series.name) + owner, loc="left", pad=2)
    locator = AutoDateLocator(minticks=3, maxticks=8)
    stack[-1].xaxis.set_major_locator(locator)
    stack[-1].xaxis.set_major_formatter(ConciseDateFormatter(locator))
    times = [point.unix_s for series in shown for point in series.points]
    room_s = max(0.03 * (max(times) - min(times)), DAY_S / 2)
    stack[-1].set_xlim(_moment(min(times) - room_s), _moment(max(times) + room_s))
    stack[-1].set_xlabel("time (UTC)")


def _panel(axes: Axes, series: Series) -> None:
    """Values with errors, the band in which each was expected, and those outside."""
    times = np.array([_moment(one.unix_s) for one in series.points])
    values = np.array([one.value for one in series.points])
    errors = np.array([one.sigma or 0.0 for one in series.points])
    known = np.array([band is not None for band in series.bands])
    if known.any():
        centre = np.array([band.centre for band in series.bands if band])
        half = np.array([band.half_width for band in series.bands if band])
        axes.fill_between(times[known], centre - half, centre + half, color=SKY, alpha=0.3, linewidth=0)
    axes.errorbar(times, values, errors, fmt=".-", color=BLUE, markersize=4, linewidth=0.7, elinewidth=0.7)
    out = {point.run for point, _ in series.alarms}
    places = [place for place, one in enumerate(series.points) if one.run in out]
    axes.plot(times[places], values[places], "o", color=ORANGE, markersize=8, fillstyle="none")
    _limit(axes, values, errors)
    axes.locator_params(axis="y", nbins=4)


def _limit(axes: Axes, values: np.ndarray, errors: np.ndarray) -> None:
    """Let the values set the scale: over few nights the band is far wider."""
    low, high = float(np.min(values - errors)), float(np.max(values + errors))
    room = 0.15 * (high - low) or 0.05 * abs(high) or 1.0
    axes.set_ylim(low - room, high + room)


def draw_structures(figure: Figure | SubFigure, trend: Trend) -> None:
    """Fill a figure with the RMS change of the NCPAs against the lag, and the noise taken off."""
    axes = figure.subplots()
    for colour, ((recipe, _), structure) in zip(CYCLE * 9, trend.structures.items(), strict=False):
        _structure(axes, recipe, structure, colour)
    axes.set(xscale="log", xlabel="lag [days]", ylabel="RMS change [nm]")
    axes.set_ylim(bottom=0)
    if trend.structures:
        axes.legend()


def _structure(axes: Axes, recipe: str, structure: Structure, colour: str) -> None:
    days = np.maximum(structure.lag_s / DAY_S, 1e-4)
    axes.plot(days, structure.change_nm, "o-", color=colour, label=f"{recipe}: NCPAs, noise taken off")
    axes.plot(days, np.sqrt(structure.noise_nm2), "--", color=colour, label="what noise alone would show")


def _moment(unix_s: float) -> datetime:
    return datetime.fromtimestamp(unix_s, UTC)


def label(name: str) -> str:
    """Name of a number with its unit in brackets, as an axis has it."""
    plain, _, unit = name.rpartition("_")
    if unit not in UNITS:
        return name.replace("_", " ")
    words = [SPELT.get(word, word) for word in plain.split("_")]
    return f"{' '.join(words)} [{unit}]"
