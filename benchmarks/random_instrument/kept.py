"""Outcomes of draws in one file, so that a run of many hours can be gone on with in another checkout."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.jsonl import read_lines, write_lines
from benchmarks.random_instrument.cases import Case
from irlos_pipe.conventions.modes import REPORTED_NOLLS
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text


def lay_out(file: Path, cases: Iterable[Case], folder: Path) -> None:
    """Put the outcomes of `cases` that a `file` keeps into a `folder` that lacks them; no file keeps none."""
    kept = {_key(one): one for one in read_lines(file)}
    for case in cases:
        one = kept.get((case.seed, case.index, case.diagnosed, case.without))
        place = folder / f"{case.name}.json"
        if one is not None and not place.is_file():
            write_bytes(place, json_text(one).encode())


def keep(file: Path, outcomes: Iterable[Mapping[str, Any]]) -> None:
    """Write `outcomes` into a `file`, their truth in the reported modes alone, beside those that it has."""
    every = {_key(one): one for one in (*read_lines(file), *map(_slim, outcomes))}
    write_lines(file, [every[key] for key in sorted(every)])


def _key(outcome: Mapping[str, Any]) -> tuple[int, int, bool, str]:
    return outcome["seed"], outcome["index"], outcome["diagnosed"] is not None, outcome["without"]


def _slim(outcome: Mapping[str, Any]) -> dict[str, Any]:
    reported = {str(noll) for noll in REPORTED_NOLLS}
    truth = {
        name: {noll: nm for noll, nm in modes.items() if noll in reported}
        for name, modes in outcome["truth"].items()
    }
    return {**outcome, "truth": truth}
