"""Whether anything that a finished run depends on was touched since; found without loading what would run.

A run that brought all of its products up to date leaves a stamp of what it depends on: name, size and time of
every file of the package, of its own folder, and of the inputs. While the stamp holds, all products are up to
date. Otherwise, or where the stamp does not decide, a plan has to be made.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import irlos_pipe
from irlos_pipe.conventions.errors import IrlosError
from irlos_pipe.files.atomic import write_bytes
from irlos_pipe.files.json import json_text
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.product.runfolder import RunFolder

NAME = ".standing.json"
REWRITTEN = ("run.log", "report.html")  # files that may change at any time; nothing depends on them
SIBLING_OF = "_PIX"  # a folder NAME_PIX is read together with NAME
MOST_FILES = 20000  # to list; more take longer than a plan


class _CannotTell(Exception):
    """What a run depends on lies beyond what a stamp lists."""


def inputs_stamp(inputs: Iterable[Path]) -> str:
    """Return the stamp of the files under `inputs` and next to them; empty where it is not known."""
    try:
        return _digest(line for root in sorted(inputs) for line in _around(root))
    except (OSError, _CannotTell):
        return ""


def listing_stamp(root: Path) -> str:
    """Return the stamp of all that decides which files are read of an input; empty where it is not known."""
    inputs = inputs_stamp([root])
    return _digest([_package_stamp(), inputs]) if inputs else ""


def remember_standing(run: RunFolder, inputs: str) -> None:
    """Note that all products of a `run` are up to date with `inputs`, a stamp made before they were read."""
    stamp = _stamp(run)
    if stamp and stamp["inputs"] == inputs:
        write_bytes(run.path / NAME, json_text(stamp).encode())


def is_standing(run: RunFolder) -> bool:
    """Return whether all products of a `run` are up to date for sure."""
    try:
        noted = json.loads((run.path / NAME).read_text())
    except (OSError, ValueError, RecursionError):
        return False
    return bool(noted) and noted == _stamp(run)


def _stamp(run: RunFolder) -> dict[str, str]:
    """Stamps by what they are of; empty where they are not known."""
    try:
        recipe = load_yaml(run.recipe)[0]
        package = Path(irlos_pipe.__file__).parent
        if not (package / "instrument" / f"{recipe['instrument']}.yaml").is_file():
            return {}  # a profile of somebody's own may name further files
        paths = [Path(path) for given in recipe["inputs"].values() for path in given]
        inputs = inputs_stamp(paths)
        own = (entry for entry in _entries(run.path) if entry.name not in REWRITTEN)
        parts: dict[str, Any] = {
            "package": _package_stamp(),
            "run": _digest(_line(entry) for entry in own if not entry.is_dir()),
            "inputs": inputs,
        }
    except (OSError, IrlosError, KeyError, AttributeError, TypeError, _CannotTell):
        return {}
    return parts if inputs else {}


@cache
def _package_stamp() -> str:
    """Stamp of every file of the package."""
    return _digest(_below(Path(irlos_pipe.__file__).parent))


def _digest(lines: Iterable[str]) -> str:
    found = hashlib.sha256()
    for number, line in enumerate(lines):
        if number > MOST_FILES:
            raise _CannotTell
        found.update(line.encode(errors="surrogateescape") + b"\0")
    return found.hexdigest()


def _around(root: Path) -> Iterator[str]:
    """What lies under a file or folder given as input, and next to a file."""
    if root.is_dir():
        yield from _below(root)
    else:
        yield from (_line(entry) for entry in _entries(root.parent) if not entry.is_dir())
    for folder in (root, root.parent):
        if folder.name.endswith(SIBLING_OF):
            yield from _below(folder.with_name(folder.name.removesuffix(SIBLING_OF)))


def _below(folder: Path) -> Iterator[str]:
    for entry in _entries(folder) if folder.is_dir() else ():
        if entry.is_dir():
            if entry.is_symlink():
                raise _CannotTell
            if entry.name != "__pycache__":
                yield from _below(Path(entry.path))
        else:
            yield _line(entry)


def _entries(folder: Path) -> list[os.DirEntry]:
    """Entries of a folder in a fixed order; hidden ones are read by nobody."""
    with os.scandir(folder) as entries:
        return sorted((one for one in entries if not one.name.startswith(".")), key=lambda one: one.name)


def _line(entry: os.DirEntry) -> str:
    status = entry.stat()
    return f"{entry.path} {status.st_size} {status.st_mtime_ns}"
