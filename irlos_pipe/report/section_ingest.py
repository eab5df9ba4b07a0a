"""Section on the recordings that went in."""

from __future__ import annotations

from collections import Counter

import numpy as np
from markupsafe import Markup

from irlos_pipe.frames.recording import PROFILE
from irlos_pipe.report.content import Section, Table, Text
from irlos_pipe.report.images import thumbnail
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number, plural
from irlos_pipe.stages.ingest.recording_arrays import Overview
from irlos_pipe.stages.ingest.results import IngestResults, RecordingRow

STAGE = "ingest"
MOST_THUMBNAILS = 60
COLUMNS = (
    "mean frame",
    "recording",
    "input",
    "role",
    "frames",
    "rejected",
    "missing",
    "window [px]",
    "flux [e⁻/frame]",
    "J [mag]",
    "bad pixels",
    "cosmics",
)


def ingest_section(run: RunData) -> Section:
    """Build the section."""
    rows = run.results(IngestResults).inputs
    pictures = {(r.input, r.name): _picture(r) for r in run.recordings[:MOST_THUMBNAILS]}
    table = Table(COLUMNS, [_row(row, pictures) for row in rows])
    frames = sum(row.frames for row in rows)
    return Section(
        STAGE,
        "Recordings",
        f"{plural(len(rows), 'recording')}, {plural(frames, 'frame')}.",
        [table, *_reasons(rows), *_assumed(rows)],
    )


def _picture(recording: Overview) -> Markup:
    return thumbnail(np.where(recording.good, recording.mean_e, np.nan), recording.name)


def _row(row: RecordingRow, pictures: dict[tuple[str, str], Markup]) -> tuple[str, ...]:
    return (
        pictures.get((row.input, row.name), ""),
        row.name,
        row.input,
        row.role,
        number(row.frames, "d"),
        number(row.frames_rejected, "d"),
        number(row.frames_missing, "d"),
        "×".join(map(str, row.window)),
        number(row.flux_e, ".3g"),
        number(row.mag_j, "g"),
        str(len(row.bad_pixels)),
        number(row.cosmic_hits, "d"),
    )


def _reasons(rows: list[RecordingRow]) -> list[Table]:
    found = [(row.name, str(count), reason) for row in rows for reason, count in row.reasons.items()]
    return [Table(("recording", "frames", "reason"), found, "Rejected frames")] if found else []


def _assumed(rows: list[RecordingRow]) -> list[Text]:
    """Values that no file gave."""
    keys = Counter(key for row in rows for key, source in row.sources.items() if source == PROFILE)
    if not keys:
        return []
    listed = ", ".join(f"{key} ({plural(count, 'recording')})" for key, count in sorted(keys.items()))
    return [Text(f"Not in the data, taken from the instrument profile: {listed}.")]
