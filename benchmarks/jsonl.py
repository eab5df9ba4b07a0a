"""Outcomes of long runs in one file of JSON lines, small enough to be kept with the project."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from irlos_pipe.files.atomic import write_bytes

DIGITS = 6


def read_lines(file: Path) -> list[dict[str, Any]]:
    """Return the outcomes that a `file` keeps, one in each line; none of a file that is not there."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []


def write_lines(file: Path, outcomes: Iterable[dict[str, Any]]) -> None:
    """Write `outcomes` into a `file` in place of what it has, their numbers rounded to six digits."""
    lines = [json.dumps(_rounded(one), allow_nan=False, ensure_ascii=False) for one in outcomes]
    write_bytes(file, "".join(f"{line}\n" for line in lines).encode())


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
