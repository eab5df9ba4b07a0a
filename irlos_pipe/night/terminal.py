"""Text and JSON that `irlos night` prints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from irlos_pipe.conventions.errors import ExitCode
from irlos_pipe.conventions.text import aligned, and_more
from irlos_pipe.files.json import json_text
from irlos_pipe.night.tree import page_path

if TYPE_CHECKING:
    from irlos_pipe.night.state import Night, RunState
    from irlos_pipe.night.tasks import Job
    from irlos_pipe.pipeline import Step

NEW_STEP = ("all stages", "run", "no products yet")


def attention_line(state: RunState, tree: Path) -> str:
    """Return one line on the nights of a run that need a look; "" when none does.

    Parameters
    ----------
    state : RunState
        The run.
    tree : Path
        Folder of all results.
    """
    nights = [night for night in state.nights.values() if night.failures or night.doubts]
    if not nights:
        return ""
    if len(nights) == 1:
        return f"night {nights[0].date}: {_first_problem(nights[0])}; see {page_path(tree, nights[0].date)}"
    dates = ", ".join(night.date for night in nights[:3]) + (" ..." if len(nights) > 3 else "")
    return f"{len(nights)} of {len(state.nights)} nights need a look ({dates}); see {tree}/night_*.html"


def _first_problem(night: Night) -> str:
    problems = [*night.failures, *night.doubts]
    return problems[0] + and_more(problems)


def night_text(state: RunState, tree: Path) -> str:
    """Return one line per job and per page, for a `state` of a run and the `tree` of its results."""
    rows = [
        (
            night.date,
            one.name.partition("/")[2],
            one.status.replace("_", " "),
            one.action,
            "; ".join(one.reasons) or one.problem,
        )
        for night in state.nights.values()
        for one in night.reduced.values()
    ]
    rows += [
        (night.date, "page", "", "", str(page_path(tree, night.date))) for night in state.nights.values()
    ]
    return aligned(sorted(rows, key=lambda row: row[0]))


def night_json(state: RunState, tree: Path) -> str:
    """Return the outcome of a run as JSON, for its `state` and the `tree` of its results."""
    return _json(
        "irlos-night", exit_code=state.exit_code, nights=[_night(one, tree) for one in state.nights.values()]
    )


def nothing_json(reason: str) -> str:
    """Return the JSON of a run that had nothing to do."""
    return _json("irlos-night", exit_code=ExitCode.NOTHING_TO_DO, nights=[], nothing=reason)


def _json(schema: str, **content: Any) -> str:
    return json_text({"schema": schema, "schema_version": 1} | content).rstrip()


def _night(night: Night, tree: Path) -> dict[str, Any]:
    return {
        "night": night.date,
        "page": page_path(tree, night.date),
        "recordings": len(night.recordings),
        "reductions": [asdict(one) for one in night.reduced.values()],
        "calibrations": {job.task.name: job.group.choice for job in night.jobs if job.group.choice},
        "left_out": [{"path": one.recording.path, "reason": one.reason} for one in night.left_out],
        "unusable": [asdict(one) for one in night.unusable],
        "failures": night.failures,
        "doubts": night.doubts,
        "known": night.known,
        "guessed": night.guessed,
    }


def plan_text(
    plan: Sequence[tuple[Job, list[Step] | None]],
    failures: Sequence[str],
    guessed: Sequence[str],
    as_json: bool,
) -> str:
    """Return what a run would do, one line per stage, and why.

    Parameters
    ----------
    plan, failures, guessed :
        From `plan_night`.
    as_json : bool
        Return a JSON list instead of a table.
    """
    rows = [(job.task.name, *row) for job, steps in plan for row in _step_rows(steps)]
    rows += [("left out", "", "", failure) for failure in failures]
    rows += [("night guessed", "", "", line) for line in guessed]
    if as_json:
        return json_text(
            [dict(zip(("run", "stage", "action", "reason"), row, strict=True)) for row in rows]
        ).rstrip()
    return aligned(rows)


def _step_rows(steps: list[Step] | None) -> list[tuple[str, str, str]]:
    if steps is None:
        return [NEW_STEP]
    return [(step.name, step.action.value, step.reason) for step in steps]
