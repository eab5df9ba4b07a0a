"""Drawings of the slow focus loop."""

from __future__ import annotations

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import ScalarFormatter

from irlos_pipe.paper.common.variants import DEFAULT, PAPER_CHOICE
from irlos_pipe.paper.slow_loop.control import Integrator
from irlos_pipe.paper.slow_loop.experiment import UNCALIBRATED
from irlos_pipe.paper.slow_loop.results import LoopRow, SlowLoopResults
from irlos_pipe.report.drawing import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE, svg

# (sensor, frames per exposure): what it is, in the order of the tables.
CONFIGURATIONS = {
    (DEFAULT, 1): "default calibration",
    (DEFAULT, 2): "default calibration, 2 s at 0.5 Hz",
    (PAPER_CHOICE, 1): "NCPAs by DIP global",
    (UNCALIBRATED, 1): "uncalibrated",
}
LOOKS = {
    (DEFAULT, 1): (BLUE, "o"),
    (DEFAULT, 2): (PURPLE, "D"),
    (PAPER_CHOICE, 1): (GREEN, "s"),
    (UNCALIBRATED, 1): (ORANGE, "^"),
}
STAR_COLOURS = (BLUE, ORANGE, GREEN)


def time_series(drift_nm: np.ndarray, residual_nm: dict[float, np.ndarray]) -> Markup:
    """Draw the drift, and the residual of some stars.

    Parameters
    ----------
    drift_nm : ndarray, (frames,)
    residual_nm : dict of float to ndarray
        By magnitude, (frames,).
    """

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(len(residual_nm), sharex=True, sharey=True, squeeze=False)[:, 0]
        for axes, (mag_j, values), colour in zip(panels, residual_nm.items(), STAR_COLOURS, strict=False):
            axes.axhline(0, color=INK, linewidth=0.6)
            axes.plot(drift_nm, color=FAINT, linewidth=2.2, label="open loop")
            axes.plot(values, color=colour, linewidth=1.1, label=f"closed, m_J {mag_j:g}")
            axes.legend(loc="upper left", ncols=2)
            axes.set_ylabel("defocus [nm RMS]")
        panels[-1].set_xlabel("time [s]")

    return svg("loop-series", (5.2, 4.2), draw)


def against_magnitude(results: SlowLoopResults) -> Markup:
    """Draw the residual of every configuration against magnitude, with the prediction."""

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        axes.axhline(results.open_loop_nm, color=INK, linewidth=0.8, linestyle=":", label="open loop")
        for configuration, label in CONFIGURATIONS.items():
            rows = results.best_loops(*configuration)
            if rows:
                _draw_configuration(axes, rows, *LOOKS[configuration], label)
        axes.set(xlabel="J magnitude", ylabel="residual defocus [nm RMS]", yscale="log")
        axes.yaxis.set_major_formatter(ScalarFormatter())
        axes.yaxis.set_minor_formatter(ScalarFormatter())
        figure.legend(loc="outside upper center", ncols=2)

    return svg("loop-magnitude", (5.2, 4.2), draw)


def _column(rows: list[LoopRow], key: str) -> np.ndarray:
    return np.array([getattr(row, key) for row in rows], dtype=float)


def _draw_configuration(axes: Axes, rows: list[LoopRow], colour: str, marker: str, label: str) -> None:
    magnitude, residual = _column(rows, "mag_j"), _column(rows, "residual_nm")
    axes.plot(magnitude, _column(rows, "predicted_nm"), color=colour, linewidth=0.9, linestyle="--")
    error = np.nan_to_num(_column(rows, "residual_error_nm"))
    axes.errorbar(magnitude, residual, error, fmt=marker, color=colour, markersize=4.5, label=label)


def sensor_noise(results: SlowLoopResults) -> Markup:
    """Draw the noise of the measurements of every configuration against magnitude, with the expected one."""

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        for configuration, label in CONFIGURATIONS.items():
            rows = results.best_loops(*configuration)
            colour, marker = LOOKS[configuration]
            magnitude = _column(rows, "mag_j")
            axes.plot(magnitude, _column(rows, "noise_nm"), marker, color=colour, markersize=4.5, label=label)
            axes.plot(magnitude, _column(rows, "expected_noise_nm"), "--", color=colour, linewidth=0.9)
        axes.axhline(results.sky_focus_nm, color=INK, linewidth=0.8, linestyle=":")
        axes.set(xlabel="J magnitude", ylabel="noise of a measurement [nm RMS]", yscale="log")
        axes.yaxis.set_major_formatter(ScalarFormatter())

    return svg("loop-noise", (5.2, 4.0), draw)


def against_gain(results: SlowLoopResults) -> Markup:
    """Draw the residual against gain for the stars of the scan."""

    def draw(figure: Canvas) -> None:
        axes = figure.subplots()
        axes.axvline(results.largest_stable_gain, color=INK, linewidth=0.8, linestyle=":")
        for rows, colour in zip(results.scanned_stars(), STAR_COLOURS, strict=False):
            _draw_star(axes, results, rows, colour)
        axes.set(xlabel="gain", ylabel="residual defocus [nm RMS]", xlim=(0, None), ylim=(0, None))
        axes.legend()

    return svg("loop-gain", (5.2, 4.0), draw)


def _draw_star(axes: Axes, results: SlowLoopResults, rows: list[LoopRow], colour: str) -> None:
    """Points of one star, and the curve that theory draws through no point."""
    drift, noise_nm = results.drift.drift, rows[0].expected_noise_nm
    gains = np.linspace(0.03, 0.93 * results.largest_stable_gain, 60)
    curve = [Integrator(gain, 1.0, results.delay).residual_nm(drift, noise_nm) for gain in gains]
    axes.plot(gains, curve, "--", color=colour, linewidth=0.9)
    error = np.nan_to_num(_column(rows, "residual_error_nm"))
    axes.errorbar(
        _column(rows, "gain"),
        _column(rows, "residual_nm"),
        error,
        fmt="o",
        color=colour,
        markersize=4.5,
        label=f"m_J {rows[0].mag_j:g}",
    )
