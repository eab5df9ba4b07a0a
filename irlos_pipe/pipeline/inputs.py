"""The files behind the inputs of a run, and their checksums."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import InputDataError, NothingToDo
from irlos_pipe.files.atomic import write_if_changed
from irlos_pipe.files.json import json_text

CACHE_NAME = ".input_checksums.json"


@dataclass(frozen=True)
class InputFile:
    """One file of an input.

    Attributes
    ----------
    label : str
        ``<input>/<folder or file given>/<path below it>``: the same wherever the data lie. Files beside
        what was given, such as a side-car, count from its parent folder.
    """

    label: str
    path: Path
    sha256: str


def input_files(
    inputs: Mapping[str, tuple[Path, ...]],
    cache_folder: Path,
    files_of: Callable[[Path], list[Path]] | None = None,
) -> list[InputFile]:
    """List the files of all inputs with their checksums, ordered by label.

    Checksums of files whose size and time of modification did not change come from the cache
    in `cache_folder`, which is not written here (see `remember`).

    Parameters
    ----------
    inputs : mapping of str to tuple of Path
        Files and folders by input name.
    cache_folder : Path
        Folder of the cache.
    files_of : callable, optional
        ``files_of(root)``: the files that are read of a file or folder given as input; all by default.

    Raises
    ------
    NothingToDo
        When there is nothing to read of an input.
    InputDataError
        When a file cannot be read.
    """
    cache = _read_cache(cache_folder)
    found: dict[str, Path] = {}
    for name, roots in inputs.items():
        own: dict[str, Path] = {}
        for index, root in enumerate(roots):
            prefix = name if len(roots) == 1 else f"{name}[{index}]"
            own |= {f"{prefix}/{_label(path, root)}": path for path in (files_of or _all_files)(root)}
        if not own:
            raise NothingToDo(
                f"input '{name}': no recordings under {', '.join(map(str, roots))}; nothing to process"
            )
        found |= own
    return [InputFile(label, path, _checksum(path, cache)) for label, path in sorted(found.items())]


def remember(files: list[InputFile], cache_folder: Path) -> None:
    """Write the checksums of `files` to the cache in `cache_folder`."""
    entries = {str(file.path): [*_stamp(file.path), file.sha256] for file in files}
    write_if_changed(cache_folder / CACHE_NAME, json_text(entries).encode())


def _label(path: Path, root: Path) -> str:
    label = Path(os.path.relpath(path, root.parent)).as_posix()
    if not label.isprintable():  # control characters, and bytes that are no UTF-8
        raise InputDataError(f"{str(path)!r}: the name holds characters that cannot be shown; rename it")
    return label


def _all_files(root: Path) -> list[Path]:
    return list(_walk(root)) if root.is_dir() else [root]


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
