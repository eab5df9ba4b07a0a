"""One case, kept as a file as soon as it is there."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.pulls.cases import Case, outcome_of
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text


def work(case: Case, folder: Path) -> dict:
    """Return the outcome of a `case`, computed unless it lies in the `folder`."""
    path = folder / f"{case.name}.json"
    if not path.is_file():
        write_bytes(path, json_text(outcome_of(case)).encode())
    outcome = json.loads(path.read_text())
    if (outcome["seed"], outcome["frames"]) != (case.seed, case.frames):
        raise ValueError(f"{path} has another seed or number of frames; give another folder")
    return outcome
