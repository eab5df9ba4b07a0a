"""What `irlos night` tells on the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ExitCode
from irlos_pipe.conventions.text import aligned, and_more
from irlos_pipe.files.json import json_text
from irlos_pipe.night.jobs import Job
from irlos_pipe.night.page import page_path
from irlos_pipe.night.state import Night, Ran
from irlos_pipe.pipeline import Step

NEW_STEP = ("all stages", "run", "no products yet")


def concern(ran: Ran, tree: Path) -> str:
    """Return the one line for whoever must have a look; nothing when nobody must."""
    nights = [night for night in ran.nights.values() if night.failures or night.doubts]
    if not nights:
        return ""
    if len(nights) == 1:
        return f"night {nights[0].date}: {_worst(nights[0])}; see {page_path(tree, nights[0].date)}"
    dates = ", ".join(night.date for night in nights[:3]) + (" ..." if len(nights) > 3 else "")
    return f"{len(nights)} of {len(ran.nights)} nights need a look ({dates}); see {tree}/night_*.html"


def _worst(night: Night) -> str:
    """The first thing that is wrong, and how many others there are."""
    wrong = [*night.failures, *night.doubts]
    return wrong[0] + and_more(wrong)


def ran_text(ran: Ran, tree: Path) -> str:
    """Return one line per job and the pages."""
    rows = [
        (
            night.date,
            one.name.partition("/")[2],
            one.status.replace("_", " "),
            one.action,
            "; ".join(one.reasons) or one.problem,
        )
        for night in ran.nights.values()
        for one in night.reduced.values()
    ]
    rows += [(night.date, "page", "", "", str(page_path(tree, night.date))) for night in ran.nights.values()]
    return aligned(sorted(rows, key=lambda row: row[0]))


def ran_json(ran: Ran, tree: Path) -> str:
    """Return the same for scripts."""
    return json_text(
        {
            "schema": "irlos-night",
            "schema_version": 1,
            "exit_code": ran.exit_code,
            "nights": [_night(night, tree) for night in ran.nights.values()],
        }
    ).rstrip()


def _night(night: Night, tree: Path) -> dict[str, Any]:
    return {
        "night": night.date,
        "page": page_path(tree, night.date),
        "recordings": len(night.recordings),
        "reductions": [asdict(one) for one in night.reduced.values()],
        "left_out": [{"path": one.recording.path, "reason": one.reason} for one in night.left_out],
        "unusable": [asdict(one) for one in night.unusable],
        "failures": night.failures,
        "doubts": night.doubts,
    }


def nothing_json(why: str) -> str:
    """Return the same where there is nothing to do."""
    return json_text(
        {
            "schema": "irlos-night",
            "schema_version": 1,
            "exit_code": ExitCode.NOTHING_TO_DO,
            "nights": [],
            "nothing": why,
        }
    ).rstrip()


def plan_text(plan: Sequence[tuple[Job, list[Step] | None]], failures: Sequence[str], as_json: bool) -> str:
    """Return what a run would do, one line per stage, and why; and what it could not do."""
    rows = [(job.task.name, *row) for job, steps in plan for row in _steps(steps)]
    rows += [("left out", "", "", failure) for failure in failures]
    if as_json:
        return json_text(
            [dict(zip(("run", "stage", "action", "reason"), row, strict=True)) for row in rows]
        ).rstrip()
    return aligned(rows)


def _steps(steps: list[Step] | None) -> list[tuple[str, str, str]]:
    if steps is None:
        return [NEW_STEP]
    return [(step.name, step.action.value, step.reason) for step in steps]
