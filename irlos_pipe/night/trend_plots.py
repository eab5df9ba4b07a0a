"""Plots of a trend: numbers against time with their bands, and the structure function of the NCPAs."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure, SubFigure

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.files.atomic import atomic_file
from irlos_pipe.night.stability import DAY_S
from irlos_pipe.night.trend import Series, Trend, label
from irlos_pipe.report.drawing import BLUE, CYCLE, ORANGE, SKY, own_style, svg

WIDTH_IN, PANEL_IN, STRUCTURE_IN = 5.6, 0.95, 3.2
MAX_PANELS = 16  # series that are plotted
WIDEST_BAND = 3.0  # ranges of the values within which a band is shown whole
LAGS_DAYS = {1 / 24: "1 hour", 1: "1 day", 7: "1 week", 30: "1 month", 182: "6 months", 730: "2 years"}
FORMATS = (".svg", ".png", ".pdf")


def series_drawing(name: str, shown: Sequence[Series]) -> Markup:
    """Return SVG, under the id `name`, of the series in `shown` against time, one below the other."""
    return svg(name, (WIDTH_IN, 0.6 + PANEL_IN * len(shown)), lambda figure: draw_series(figure, shown))


def structure_drawing(name: str, trend: Trend) -> Markup:
    """Return SVG, under the id `name`, of the structure functions of a `trend`."""
    return svg(name, (WIDTH_IN, STRUCTURE_IN), lambda figure: draw_structures(figure, trend))


def save_plot(trend: Trend, path: Path) -> None:
    """Plot the first `MAX_PANELS` series of a `trend` and its structure functions to the file `path`.

    Raises `ConfigurationError` when the name does not end in one of `FORMATS`; `IrlosError` when it cannot be
    written.
    """
    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise ConfigurationError(f"--plot {path}: give a name that ends in {', '.join(FORMATS)}")
    shown = trend.series[:MAX_PANELS]
    heights = (0.6 + PANEL_IN * len(shown), STRUCTURE_IN if trend.stabilities else 0.0)
    with own_style():
        figure = Figure(figsize=(1.3 * WIDTH_IN, sum(heights)), facecolor="white")
        if trend.stabilities:
            upper, lower = figure.subfigures(2, squeeze=False, height_ratios=heights)[:, 0]
            draw_structures(lower, trend)
        else:
            upper = figure
        draw_series(upper, shown)
        with atomic_file(path) as stream:
            figure.savefig(stream, format=kind[1:], dpi=150)


def draw_series(figure: Figure | SubFigure, shown: Sequence[Series]) -> None:
    """Fill `figure` with one panel per series of `shown`, over a common time axis."""
    stack = figure.subplots(len(shown), sharex=True, squeeze=False)[:, 0]
    names = [series.name for series in shown]
    for axes, series in zip(stack, shown, strict=True):
        _panel(axes, series)
        owner = f"  ({', '.join(series.owner)})" if names.count(series.name) > 1 else ""
        axes.set_title(label(series.name) + _plain(owner), loc="left", pad=2)
    locator = AutoDateLocator(minticks=3, maxticks=8)
    stack[-1].xaxis.set_major_locator(locator)
    stack[-1].xaxis.set_major_formatter(ConciseDateFormatter(locator))
    times = [point.unix_s for series in shown for point in series.points]
    room_s = max(0.03 * (max(times) - min(times)), DAY_S / 2)
    stack[-1].set_xlim(_moment(min(times) - room_s), _moment(max(times) + room_s))
    stack[-1].set_xlabel("time (UTC)")


def _panel(axes: Axes, series: Series) -> None:
    """Plot values with errors, the band in which each was expected, and circles around those outside."""
    times = np.array([_moment(one.unix_s) for one in series.points])
    values = np.array([one.value for one in series.points])
    errors = np.array([one.sigma or 0.0 for one in series.points])
    bands = [one.band for one in series.points]
    ends = np.array([(band.low, band.high) for band in bands if band]).reshape(-1, 2)
    if len(ends):
        known = [band is not None for band in bands]
        axes.fill_between(times[known], ends[:, 0], ends[:, 1], color=SKY, alpha=0.3, linewidth=0)
    axes.errorbar(times, values, errors, fmt=".", color=BLUE, markersize=4, elinewidth=0.7)
    _line(axes, series)
    for limit in series.limits or ():
        if limit is not None:
            axes.axhline(limit, color=ORANGE, linewidth=0.8, linestyle="--")
    out = [bool(one.alarm) for one in series.points]
    axes.plot(times[out], values[out], "o", color=ORANGE, markersize=8, fillstyle="none")
    # Scaled to values and band, which over few nights may be too wide to be shown whole.
    low, high = float(np.min(values - errors)), float(np.max(values + errors))
    span = high - low or 0.1 * abs(high) or 1.0
    every = ends.ravel()
    near = every[(low - WIDEST_BAND * span < every) & (every < high + WIDEST_BAND * span)].tolist()
    low, high = min([low, *near]), max([high, *near])
    room = 0.1 * (high - low) or span
    axes.set_ylim(low - room, high + room)
    axes.locator_params(axis="y", nbins=4)


def _line(axes: Axes, series: Series) -> None:
    """Join the medians of the nights: a line between points of one night would look like an error."""
    nights: dict[str, list[tuple[float, float]]] = {}
    for one in series.points:
        nights.setdefault(one.night, []).append((one.unix_s, one.value))
    moments, medians = np.array([np.median(members, axis=0) for members in nights.values()]).T
    axes.plot(np.array(list(map(_moment, moments))), medians, color=BLUE, linewidth=0.7)


def draw_structures(figure: Figure | SubFigure, trend: Trend) -> None:
    """Fill `figure` with the RMS change of the NCPAs of a `trend` against the lag, and the noise."""
    axes = figure.subplots()
    lags = []
    for colour, ((recipe, _), (found, _)) in zip(CYCLE * 9, trend.stabilities.items(), strict=False):
        days, name = np.maximum(found.lag_s / DAY_S, 1e-4), f"{_plain(recipe)}: NCPAs, noise subtracted"
        axes.plot(days, found.change_nm, "o-", color=colour, label=name)
        axes.fill_between(days, found.low_nm, found.high_nm, color=colour, alpha=0.2, linewidth=0)
        axes.plot(days, np.sqrt(found.noise_nm2), "--", color=colour, label="noise alone")
        lags += (found.lag_s / DAY_S).tolist()
    axes.set(xscale="log", xlabel="time between two calibrations", ylabel="RMS change [nm]")
    axes.set_ylim(bottom=0)
    _label_lags(axes, min(lags), max(lags))
    axes.legend()


def _label_lags(axes: Axes, low: float, high: float) -> None:
    """Ticks at times that people know, as far as the lags [days] reach."""
    axes.set_xlim(max(low, 1e-4) / 1.5, max(high, 1e-4) * 1.5)
    ticks = {days: text for days, text in LAGS_DAYS.items() if low / 1.5 <= days <= high * 1.5}
    axes.set_xticks(list(ticks or {low: ""}), list(ticks.values()) or [f"{low:.2g} days"])
    axes.minorticks_off()


def _plain(text: str) -> str:
    """Text that is no formula."""
    return text.replace("$", r"\$")


def _moment(unix_s: float) -> datetime:
    return datetime.fromtimestamp(unix_s, UTC)
