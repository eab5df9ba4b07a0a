"""Outcomes kept in one file, so that a suite of many hours can be gone on with in another checkout."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.diagnose_suite.cases import CLEAN, RAMP_CLEAN, Case
from benchmarks.diagnose_suite.judging import Outcome
from benchmarks.diagnose_suite.working import Folder
from benchmarks.jsonl import read_lines, write_lines
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text

OF_DIAGNOSIS = ("verdict", "grade", "gap", "chi2_nu", "seconds", "untestable", "why_unknown")
OF_STEP = ("effect", "indistinguishable", "parameters", "sigma", "significance")


def lay_out(file: Path, cases: Iterable[Case], folder: Folder) -> None:
    """Put the outcomes of `cases` that a `file` keeps into a `folder` that lacks them; no file keeps none."""
    kept = {(one["case"], one["truth"]["suite_seed"]): one for one in read_lines(file)}
    for case in cases:
        one, place = kept.get((case.name, case.suite_seed)), folder.outcome(case)
        if one is not None and not place.is_file():
            place.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(place, json_text(one).encode())


def keep(file: Path, outcomes: Sequence[Outcome]) -> None:
    """Write `outcomes` into a `file`, without what no score needs, beside those that it has."""
    every = {(one["truth"]["suite_seed"], one["case"]): one for one in (*read_lines(file), *outcomes)}
    write_lines(file, [_slim(every[key]) for key in sorted(every)])


def _slim(outcome: Outcome) -> Outcome:
    diagnosis, clean = outcome["diagnosis"], outcome["truth"]["kind"] in (CLEAN, RAMP_CLEAN)
    slim = {key: diagnosis[key] for key in OF_DIAGNOSIS if key in diagnosis}
    slim["steps"] = [{key: step[key] for key in OF_STEP if key in step} for step in diagnosis["steps"]]
    slim["nearest"] = {"effect": (diagnosis.get("nearest") or {}).get("effect")}
    slim["mdb"] = diagnosis["mdb"] if clean else {}  # those of clean recordings are the smallest sizes
    return outcome | {"diagnosis": slim}
