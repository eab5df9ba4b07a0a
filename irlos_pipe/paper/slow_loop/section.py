"""Section on the slow focus loop closed in simulation."""

from __future__ import annotations

import math

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import ScalarFormatter

from irlos_pipe.control.linear_theory import Integrator
from irlos_pipe.paper.common.section import array_of
from irlos_pipe.paper.common.variants import DEFAULT, PAPER_CHOICE
from irlos_pipe.paper.slow_loop.experiment import UNCALIBRATED
from irlos_pipe.paper.slow_loop.results import LoopRow, SlowLoopResults
from irlos_pipe.paper.slow_loop.two_by_two import CENTROIDS, LIFT
from irlos_pipe.report.content import Figure, Section, Table
from irlos_pipe.report.drawing import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE, SKY, svg
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import MISSING, number, plural, with_error

STAGE = SlowLoopResults.stage
# (sensor, frames per exposure): what it is, in the order of the tables.
CONFIGURATIONS = {
    (DEFAULT, 1): "default calibration",
    (DEFAULT, 2): "default calibration, 2 s at 0.5 Hz",
    (PAPER_CHOICE, 1): "NCPAs by DIP global",
    (UNCALIBRATED, 1): "uncalibrated",
    (CENTROIDS, 1): "2x2 mode, centroids",
    (LIFT, 1): "2x2 mode, fit of the four images",
}
LOOKS = {
    (DEFAULT, 1): (BLUE, "o"),
    (DEFAULT, 2): (PURPLE, "D"),
    (PAPER_CHOICE, 1): (GREEN, "s"),
    (UNCALIBRATED, 1): (ORANGE, "^"),
    (CENTROIDS, 1): (INK, "x"),
    (LIFT, 1): (SKY, "v"),
}
STAR_COLOURS = (BLUE, ORANGE, GREEN)
SERIES_CAPTION = (
    "First drift on the first sky, default calibration. Grey: the drift itself, which an open loop leaves."
)
MAGNITUDE_CAPTION = (
    "Every star at the gain that theory calls best. Dashed: prediction from the spectrum of the drift, the "
    "noise of photons and detector, and the AO residual's own defocus; nothing is fitted. Bars: standard "
    "error over runs."
)
NOISE_CAPTION = (
    "Measured minus true residual, symbols as above. Dashed: Cramér–Rao bound, of centroids the scatter of "
    "drawn images, with the AO residual's own defocus; dotted: that alone."
)
GAIN_CAPTION = (
    "Default calibration, frames of 1 s. Dashed: prediction; dotted: gain at which the loop oscillates."
)
TABLE_CAPTION = (
    "Sensor noise: measured minus true residual, the AO residual's own defocus included. Bias: RMS over "
    "skies of the mean residual. Lost: measurements that the sensor could not give. Gain margin: factor to "
    "oscillation. The 2x2 mode is told its own zero without error."
)
COLUMNS = (
    "m_J",
    "sensor noise [nm]",
    "bound [nm]",
    "best gain, theory",
    "best gain, scan",
    "predicted [nm]",
    "residual [nm]",
    "bias [nm]",
    "lost",
    "diverged",
    "sensor slope",
    "gain margin",
)


def section(run: RunData) -> Section:
    """Build the section."""
    results = run.results(SlowLoopResults)
    figures = [Figure(_against_magnitude(results), "Residual against magnitude", MAGNITUDE_CAPTION)]
    best = results.best_loops(results.default)
    if best:
        series = _series(run, results, best)
        figures.insert(0, Figure(series, "Bright and faint star", SERIES_CAPTION))
    figures.append(Figure(_sensor_noise(results), "The loop's sensor", NOISE_CAPTION))
    if results.scanned_stars():
        figures.append(Figure(_against_gain(results), "Residual against gain", GAIN_CAPTION))
    return Section(STAGE, "Slow focus loop on LIFT", _lead(results, best), [*figures, *_tables(results)])


def _lead(results: SlowLoopResults, best: list[LoopRow]) -> str:
    lead = (
        f"Sodium layer drifting by {results.drift.rms_change_1s_nm:.1f} nm RMS of defocus in a second; "
        f"{results.open_loop_nm:.0f} nm RMS without a loop"
    )
    if not best:
        return f"{lead}."
    return (
        f"{lead}, {number(best[0].residual_nm)} nm with it at m_J {best[0].mag_j:g}. "
        f"{plural(best[0].runs, 'run')} per point. The NCPAs have no tip, tilt and defocus of their own."
    )


def _series(run: RunData, results: SlowLoopResults, best: list[LoopRow]) -> Markup:
    """The brightest star, and the faintest whose loop has never diverged."""
    drift, residual = (array_of(run, STAGE, name)[0, 0] for name in ("drift_nm", "residual_nm"))
    held = [row for row in best if not row.diverged]
    chosen = [best[0], *held[-1:]]
    return _time_series(drift, {row.mag_j: residual[results.loops.index(row)] for row in chosen})


def _tables(results: SlowLoopResults) -> list[Table]:
    tables: list[Table] = []
    for configuration, label in CONFIGURATIONS.items():
        rows = results.best_loops(*configuration)
        if rows:
            body = [_row(row, results) for row in rows]
            caption = "" if tables else TABLE_CAPTION
            tables.append(Table(COLUMNS, body, label[0].upper() + label[1:], caption))
    return tables


def _row(row: LoopRow, results: SlowLoopResults) -> tuple[str, ...]:
    return (
        f"{row.mag_j:g}",
        number(row.noise_nm),
        number(row.bound_nm),
        number(row.best_gain, ".2f"),
        _best_of_scan(row, results),
        number(row.predicted_nm),
        with_error(row.residual_nm, row.residual_error_nm),
        number(row.bias_nm),
        number(row.lost, ".0%"),
        f"{row.diverged} of {row.runs}",
        number(row.slope, ".2f"),
        number(row.gain_margin),
    )


def _best_of_scan(row: LoopRow, results: SlowLoopResults) -> str:
    """Gain with the smallest residual of all that were tried on this star; a dash if only one was."""
    tried = [one for one in results.same_star(row) if not one.diverged and not math.isnan(one.residual_nm)]
    if len(tried) < 2:
        return MISSING
    return number(min(tried, key=lambda one: one.residual_nm).gain, ".2f")


# -- drawings --------------------------------------------------------------------------------------


def _time_series(drift_nm: np.ndarray, residual_nm: dict[float, np.ndarray]) -> Markup:
    """The drift, and the residual of some stars by magnitude, (frames,) each."""

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


def _against_magnitude(results: SlowLoopResults) -> Markup:
    """The residual of every configuration against magnitude, with the prediction."""

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


def _sensor_noise(results: SlowLoopResults) -> Markup:
    """The noise of the measurements of every configuration against magnitude, with the expected one."""

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


def _against_gain(results: SlowLoopResults) -> Markup:
    """The residual against gain for the stars of the scan."""

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
    drift, noise_nm = results.drift, rows[0].expected_noise_nm
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
