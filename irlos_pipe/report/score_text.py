"""How far a run is from the truth, as tables of text."""

from __future__ import annotations

import math

from irlos_pipe.conventions.modes import REPORTED_TEXT
from irlos_pipe.conventions.text import aligned
from irlos_pipe.product.printed import CalibrationScore, MethodScore, RampScore, Score


def score_text(score: Score) -> str:
    """Return a table for the calibration and one for the ramp of a `score`."""
    tables = [
        _calibration_table(score.calibration) if score.calibration else [],
        _ramp_table(score.ramp) if score.ramp else [],
    ]
    return "\n\n".join(aligned(table, numbers=True) for table in tables if table)


def _calibration_table(score: CalibrationScore) -> list[tuple[str, ...]]:
    against = ("against the static modes", "its pulls") if score.static_known else ()
    names = ", ".join(score.recordings)
    return [
        (f"calibration ({names})", f"error, {REPORTED_TEXT}", "defocus", "time", *against),
        *(_method_row(one, score.static_known) for one in score.methods),
    ]


def _method_row(one: MethodScore, static_known: bool) -> tuple[str, ...]:
    static = (f"{one.static_error_nm:.1f} nm RMS", f"{one.pull_rms:.2f}") if static_known else ()
    return (
        one.method,
        f"{one.error_nm:.1f} nm RMS",
        f"{one.defocus_error_nm:+.1f} nm",
        f"{one.seconds:.1f} s",
        *static,
    )


def _ramp_table(score: RampScore) -> list[tuple[str, ...]]:
    rows = [
        ("frames against the introduced defocus", score.against_introduced_nm),
        ("frames against the true mean defocus", score.against_true_nm),
        ("means of recordings against the true mean defocus", score.means_against_true_nm),
    ]
    return [
        (f"ramp ({score.recordings} recordings, {score.frames} frames)", "error"),
        *((name, f"{rms:.1f} nm RMS") for name, rms in rows if math.isfinite(rms)),
    ]
