"""Problems of nights that somebody has seen: they are shown as known and not reported again.

They stand in a text file of the tree, one line each as it was reported, which may be edited. A problem that
changes is a new one.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.conventions.text import printable
from irlos_pipe.files.atomic import write_if_changed
from irlos_pipe.files.regular import read_regular

NAME = "acknowledged.txt"
HEAD = "# Problems that are known and not reported again; delete a line to be told again."


def read_acknowledged(tree: Path) -> frozenset[str]:
    """Return the problems that are acknowledged in a `tree`, none without the file.

    Raises
    ------
    IrlosError
        When the file cannot be read.
    """
    path = tree / NAME
    if not path.is_file():
        return frozenset()
    try:
        text = read_regular(path)
    except (OSError, ValueError) as error:
        raise IrlosError(f"{path}: cannot be read: {error}; move it away") from error
    return frozenset(line for line in text.splitlines() if line.strip() and not line.startswith("#"))


def acknowledge(tree: Path, problems: Iterable[str]) -> frozenset[str]:
    """Add `problems` to those that are acknowledged in a `tree`, and return all.

    Raises
    ------
    IrlosError
        When the file cannot be read or written.
    """
    known = read_acknowledged(tree) | {as_line(problem) for problem in problems}
    write_if_changed(tree / NAME, "\n".join([HEAD, *sorted(known), ""]).encode())
    return known


def as_line(problem: str) -> str:
    """Return a `problem` as it stands in the file."""
    return printable(problem).strip()
