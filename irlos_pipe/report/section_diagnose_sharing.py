"""What recordings of several stars and nights share: findings, and the values of each."""

from __future__ import annotations

from irlos_pipe.effects.public_values import rows_of
from irlos_pipe.report.content import Table
from irlos_pipe.report.text import number, rounded_by_error
from irlos_pipe.stages.diagnose.results import DiagnoseResults, OwnValueRow, SharingRow

EVIDENCE = ("name", "finding", "differences", "Δχ² (parameters)", "held-out z")
VALUES = ("name", "recording", "parameter", "value", "seen there")
STARS = ("recording", "star", "change of the NCPAs, RMS per mode [nm]")
FINDINGS = {"common": "common to all", "differs": "differs", "open": "these data do not tell"}


def sharing_tables(results: DiagnoseResults) -> list[Table]:
    """Return findings with their evidence, the values of each recording, and changes of the wavefront."""
    if not results.recordings:
        return []
    found = [_evidence(one) for one in results.sharing]
    values = [row for one in results.sharing for own in one.values for row in _values(one.effect, own)]
    stars = [
        (one.name, one.star or "–", rounded_by_error(one.ncpa_change_nm, one.sigma_nm))
        for one in results.recordings
    ]
    tables = [
        Table(EVIDENCE, found, "One value for all recordings, or each its own"),
        Table(VALUES, values, "Fitted to each recording", folded=True),
        Table(STARS, stars, "Stars and nights"),
    ]
    return [table for table in tables if table.rows]


def _evidence(one: SharingRow) -> tuple[str, ...]:
    return (
        one.effect,
        FINDINGS.get(one.finding, one.finding),
        number(one.significance, ".1f", "σ"),
        f"{number(one.chi2_fall, '.0f')} ({one.parameters})",
        number(one.held_out_z, ".1f"),
    )


def _values(effect: str, own: OwnValueRow) -> list[tuple[str, ...]]:
    values, errors = rows_of(own.parameters), dict(rows_of(own.sigma))
    head, rest = (effect, own.recording), number(own.significance, ".1f", "σ")
    return [
        (
            *(head if first else ("", "")),
            name,
            rounded_by_error(value, errors.get(name)) if isinstance(value, float) else str(value),
            rest if first else "",
        )
        for first, (name, value) in zip([True] + [False] * len(values), values, strict=False)
    ]
