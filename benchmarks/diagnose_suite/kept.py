"""Outcomes kept in one file, so that a suite of many hours can be gone on with in another checkout."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.diagnose_suite.cases import CLEAN, RAMP_CLEAN, Case
from benchmarks.diagnose_suite.judging import Outcome
from benchmarks.diagnose_suite.working import Folder
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text

OF_DIAGNOSIS = ("verdict", "grade", "gap", "chi2_nu", "seconds", "untestable", "why_unknown")
OF_STEP = ("effect", "indistinguishable", "parameters", "sigma", "significance")
DIGITS = 6


def lay_out(file: Path, cases: Iterable[Case], folder: Folder) -> None:
    """Put the outcomes of `cases` that a `file` keeps into a `folder` that lacks them; no file keeps none."""
    kept = {(one["case"], one["truth"]["suite_seed"]): one for one in read_kept(file)}
    for case in cases:
        one, place = kept.get((case.name, case.suite_seed)), folder.outcome(case)
        if one is not None and not place.is_file():
            place.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(place, json_text(one).encode())


def read_kept(file: Path) -> list[Outcome]:
    """Return the outcomes that a file keeps, one in each line; none of a file that is not there."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []


def keep(file: Path, outcomes: Sequence[Outcome]) -> None:
    """Write `outcomes` into a `file`, without what no score needs, beside those that it has."""
    every = {(one["truth"]["suite_seed"], one["case"]): one for one in (*read_kept(file), *outcomes)}
    lines = [json.dumps(_slim(every[key]), allow_nan=False, ensure_ascii=False) for key in sorted(every)]
    write_bytes(file, "".join(f"{line}\n" for line in lines).encode())


def _slim(outcome: Outcome) -> Outcome:
    diagnosis, clean = outcome["diagnosis"], outcome["truth"]["kind"] in (CLEAN, RAMP_CLEAN)
    slim = {key: diagnosis[key] for key in OF_DIAGNOSIS if key in diagnosis}
    slim["steps"] = [{key: step[key] for key in OF_STEP if key in step} for step in diagnosis["steps"]]
    slim["nearest"] = {"effect": (diagnosis.get("nearest") or {}).get("effect")}
    slim["mdb"] = diagnosis["mdb"] if clean else {}  # those of clean recordings are the smallest sizes
    return _rounded(outcome | {"diagnosis": slim})


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
