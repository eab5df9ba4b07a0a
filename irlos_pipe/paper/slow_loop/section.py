"""Section on the slow focus loop closed in simulation."""

from __future__ import annotations

import math

from markupsafe import Markup

from irlos_pipe.paper.common.section import array_of
from irlos_pipe.paper.slow_loop.plots import (
    CONFIGURATIONS,
    against_gain,
    against_magnitude,
    sensor_noise,
    time_series,
)
from irlos_pipe.paper.slow_loop.results import LoopRow, SlowLoopResults
from irlos_pipe.report.content import Figure, Section, Table
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import MISSING, number, plural, with_error

STAGE = SlowLoopResults.stage
SERIES_CAPTION = (
    "First drift on the first sky, default calibration. Grey: the drift itself, which an open loop leaves."
)
MAGNITUDE_CAPTION = (
    "Every star at the gain that theory calls best. Dashed: prediction from the spectrum of the drift, the "
    "Cramér–Rao bound and the AO residual's own defocus; nothing is fitted. Bars: standard error over runs."
)
NOISE_CAPTION = (
    "Measured minus true residual, symbols as above. Dashed: Cramér–Rao bound with the AO residual's own "
    "defocus; dotted: that alone."
)
GAIN_CAPTION = (
    "Default calibration, frames of 1 s. Dashed: prediction; dotted: gain at which the loop oscillates."
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
    figures = [Figure(against_magnitude(results), "Residual against magnitude", MAGNITUDE_CAPTION)]
    best = results.best_loops(results.default)
    if best:
        series = _series(run, results, best)
        figures.insert(0, Figure(series, "Bright and faint star", SERIES_CAPTION))
    figures.append(Figure(sensor_noise(results), "LIFT as the loop's sensor", NOISE_CAPTION))
    if results.scanned_stars():
        figures.append(Figure(against_gain(results), "Residual against gain", GAIN_CAPTION))
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
    return time_series(drift, {row.mag_j: residual[results.loops.index(row)] for row in chosen})


def _tables(results: SlowLoopResults) -> list[Table]:
    tables: list[Table] = []
    for configuration, label in CONFIGURATIONS.items():
        rows = results.best_loops(*configuration)
        if rows:
            body = [_row(row, results) for row in rows]
            caption = "" if tables else TABLE_CAPTION
            tables.append(Table(COLUMNS, body, label[0].upper() + label[1:], caption))
    return tables


TABLE_CAPTION = (
    "Sensor noise: measured minus true residual, the AO residual's own defocus included. Bias: RMS over "
    "skies of the mean residual. Lost: measurements that LIFT could not give. Gain margin: factor to "
    "oscillation."
)


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
