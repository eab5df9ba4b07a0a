"""Section on the recordings that went in."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from markupsafe import Markup

from irlos_pipe.frames.blocks import mean_frame, picked
from irlos_pipe.frames.recording import Recording
from irlos_pipe.report.content import Section, Table, Text
from irlos_pipe.report.images import thumbnail
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.text import number, plural

STAGE = "ingest"
MOST_THUMBNAILS = 60
ASSUMED = "instrument profile"
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
    rows = run.results(STAGE).get("inputs", [])
    pictures = {(r.input, r.name): _picture(r) for r in run.recordings[:MOST_THUMBNAILS]}
    table = Table(COLUMNS, [_row(row, pictures) for row in rows])
    frames = sum(row.get("frames") or 0 for row in rows)
    return Section(
        STAGE,
        "Recordings",
        f"{plural(len(rows), 'recording')}, {plural(frames, 'frame')}.",
        [table, *_reasons(rows), *_assumed(rows)],
    )


def _picture(recording: Recording) -> Markup:
    frames = picked(recording.images_e, recording.used)
    mean = mean_frame(frames) if len(frames) else np.zeros(recording.window)
    return thumbnail(np.where(recording.pixel_mask, mean, np.nan))


def _row(row: dict[str, Any], pictures: dict[tuple[str, str], Markup]) -> tuple[str, ...]:
    counts = (number(row.get(key), "d") for key in ("frames", "frames_rejected", "frames_missing"))
    window = "×".join(str(side) for side in row.get("window") or [])
    return (
        pictures.get((row.get("input"), row.get("name")), ""),
        row.get("name", ""),
        row.get("input", ""),
        row.get("role", ""),
        *counts,
        window,
        number(row.get("flux_e"), ".3g"),
        number(row.get("mag_j"), "g"),
        str(len(row.get("bad_pixels") or [])),
        number(row.get("cosmic_hits"), "d"),
    )


def _reasons(rows: list[dict[str, Any]]) -> list[Table]:
    found = [
        (row.get("name", ""), str(count), reason)
        for row in rows
        for reason, count in (row.get("reasons") or {}).items()
    ]
    return [Table(("recording", "frames", "reason"), found, "Rejected frames")] if found else []


def _assumed(rows: list[dict[str, Any]]) -> list[Text]:
    """Values that no file gave."""
    keys = Counter(
        key for row in rows for key, source in (row.get("sources") or {}).items() if source == ASSUMED
    )
    if not keys:
        return []
    told = ", ".join(f"{key} ({plural(count, 'recording')})" for key, count in sorted(keys.items()))
    return [Text(f"Not in the data, taken from the instrument profile: {told}.")]
