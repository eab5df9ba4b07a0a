"""The files behind the inputs of a run, and their checksums."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import InputDataError, NothingToDo
from irlos_pipe.files.atomic import write_if_changed
from irlos_pipe.files.json import json_text

FITS_SUFFIX = re.compile(r"\.(fits?|fts)(\.gz|\.fz)?$", re.IGNORECASE)
CACHE_NAME = ".input_checksums.json"


@dataclass(frozen=True)
class InputFile:
    """One file of an input.

    Attributes
    ----------
    label : str
        ``<input>/<folder or file given>/<path below it>``: the same wherever the data lie.
    """

    label: str
    path: Path
    sha256: str


def input_files(inputs: Mapping[str, tuple[Path, ...]], cache_folder: Path) -> list[InputFile]:
    """List the files of all inputs with their checksums, ordered by label.

    Checksums of files whose size and time of modification did not change come from the cache
    in `cache_folder`, which is not written here (see `remember`).

    Raises
    ------
    NothingToDo
        When an input is an empty folder.
    InputDataError
        When a file cannot be read.
    """
    cache = _read_cache(cache_folder)
    found = {}
    for name, roots in inputs.items():
        for index, root in enumerate(roots):
            prefix = name if len(roots) == 1 else f"{name}[{index}]"
            found.update((f"{prefix}/{label}", path) for label, path in _labelled(root, name))
    return [InputFile(label, path, _checksum(path, cache)) for label, path in sorted(found.items())]


def remember(files: list[InputFile], cache_folder: Path) -> None:
    """Write the cache of checksums."""
    entries = {str(file.path): [*_stamp(file.path), file.sha256] for file in files}
    write_if_changed(cache_folder / CACHE_NAME, json_text(entries).encode())


def _labelled(root: Path, name: str) -> Iterator[tuple[str, Path]]:
    """Yield label and path of all files that belong to an input."""
    files = list(_walk(root)) if root.is_dir() else [root, *_companions(root)]
    if not files:
        raise NothingToDo(f"input '{name}': {root} holds no files; nothing to process")
    return ((_label(path, root), path) for path in files)


def _label(path: Path, root: Path) -> str:
    label = path.relative_to(root.parent).as_posix()
    if not label.isprintable():  # control characters, and bytes that are no UTF-8
        raise InputDataError(f"{str(path)!r}: the name holds characters that cannot be shown; rename it")
    return label


def _companions(path: Path) -> Iterator[Path]:
    """Yield what belongs to a data file and lies beside it: side-cars and detector calibrations."""
    own_sidecar = FITS_SUFFIX.sub("", path.name) + ".yaml"
    for other in path.parent.iterdir():
        if other.name in (own_sidecar, "acquisition.yaml") or other.name.startswith("IRAcq."):
            yield other


def _walk(folder: Path) -> Iterator[Path]:
    for where, subfolders, names in os.walk(folder, onerror=_unreadable):
        subfolders[:] = [name for name in subfolders if not name.startswith(".")]
        yield from (Path(where, name) for name in names if not name.startswith("."))


def _unreadable(error: OSError) -> None:
    raise InputDataError(f"{error.filename}: cannot be read: {error.strerror}") from error


def _read_cache(folder: Path) -> dict[str, Any]:
    try:
        entries = json.loads((folder / CACHE_NAME).read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return entries if isinstance(entries, dict) else {}


def _checksum(path: Path, cache: Mapping[str, Any]) -> str:
    try:
        match cache.get(str(path)):
            case [int(size), int(time_ns), str(sha256)] if [size, time_ns] == _stamp(path):
                return sha256
        with open(path, "rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputDataError(f"{path}: cannot be read: {error.strerror}") from error


def _stamp(path: Path) -> list[int]:
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]
