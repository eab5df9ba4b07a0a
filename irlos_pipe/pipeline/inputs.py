"""The files behind the inputs of a run, and their checksums."""

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import InputDataError, NothingToDo
from irlos_pipe.files.atomic import write_if_changed
from irlos_pipe.files.json import json_text
from irlos_pipe.files.regular import open_regular, read_regular
from irlos_pipe.product.runfolder import listing_stamp

CACHE_NAME = ".input_checksums.json"
LISTS = "lists"  # key of the lists of files among the absolute paths of the cache


@dataclass(frozen=True)
class InputFile:
    # ``<input>/<folder or file given>/<path below it>``: the same wherever the data lie. Files next to what
    # was given, such as a side-car, count from its parent folder.
    label: str
    path: Path
    sha256: str
    # Size, times and place on the disk when the checksum was taken.
    stamp: tuple[int, ...] = field(default=(), compare=False)
    # What was given as input, and the stamp of all that decided which of its files are read.
    root: Path = field(default=Path(), compare=False)
    listed: str = field(default="", compare=False)


def input_files(
    inputs: Mapping[str, tuple[Path, ...]],
    cache_folder: Path,
    files_of: Callable[[Path], list[Path]] | None = None,
) -> list[InputFile]:
    """List the files of all inputs with their checksums, ordered by label.

    Checksums of files whose size, times and place did not change come from the cache
    in `cache_folder`, which is not written here (see `remember`), and so does the list of the files that
    are read of an input while nothing in it or next to it was touched: to tell, every file has to be opened.

    ``files_of(root)`` gives the files that are read of a file or folder given as input; all by default.

    Raises `NothingToDo` when there is nothing to read of an input, and `InputDataError` when a folder cannot
    be read, or a name cannot be shown.
    """
    cache = _read_cache(cache_folder)
    found: dict[str, tuple[Path, Path, str]] = {}
    for name, roots in inputs.items():
        own: dict[str, tuple[Path, Path, str]] = {}
        for index, root in enumerate(roots):
            prefix = name if len(roots) == 1 else f"{name}[{index}]"
            listed, paths = _listed(root, cache, files_of or _all_files)
            own |= {f"{prefix}/{_label(path, root)}": (path, root, listed) for path in paths}
        if not own:
            raise NothingToDo(
                f"input '{name}': no recordings under {', '.join(map(str, roots))}; nothing to process"
            )
        found |= own
    return [_input_file(label, *one, cache) for label, one in sorted(found.items())]


def remember(files: list[InputFile], cache_folder: Path) -> None:
    """Write the checksums of `files`, and which of an input they are, to the cache in `cache_folder`."""
    entries: dict[str, Any] = {str(file.path): [*file.stamp, file.sha256] for file in files}
    lists: dict[str, list[str]] = {}
    for file in files:
        lists.setdefault(str(file.root), [file.listed]).append(str(file.path))
    entries[LISTS] = {root: entry for root, entry in lists.items() if entry[0]}
    write_if_changed(cache_folder / CACHE_NAME, json_text(entries).encode())


def require_unchanged(files: Iterable[InputFile]) -> None:
    """Raise InputDataError if one of the `files` is no longer the one whose checksum was taken."""
    for file in files:
        if _stamp(file.path) != file.stamp:
            raise InputDataError(f"{file.path}: changed during the run; run again when it is complete")


def _label(path: Path, root: Path) -> str:
    label = Path(os.path.relpath(path, root.parent)).as_posix()
    if not label.isprintable():  # control characters, and bytes that are no UTF-8
        raise InputDataError(f"{str(path)!r}: the name holds characters that cannot be shown; rename it")
    return label


def _all_files(root: Path) -> list[Path]:
    def unreadable(error: OSError) -> None:
        raise InputDataError(f"{error.filename}: cannot be read: {error.strerror}") from error

    found = [] if root.is_dir() else [root]
    for where, subfolders, names in os.walk(root, onerror=unreadable) if root.is_dir() else ():
        subfolders[:] = [name for name in subfolders if not name.startswith(".")]
        paths = (Path(where, name) for name in names if not name.startswith("."))
        found += filter(Path.is_file, paths)  # neither pipes nor devices
    return found


def _read_cache(folder: Path) -> dict[str, Any]:
    try:
        entries = json.loads(read_regular(folder / CACHE_NAME))
    except (OSError, ValueError, RecursionError):
        return {}
    return entries if isinstance(entries, dict) else {}


def _listed(
    root: Path, cache: Mapping[str, Any], files_of: Callable[[Path], list[Path]]
) -> tuple[str, list[Path]]:
    """The files that are read of an input, and the stamp under which they may be remembered."""
    stamp = listing_stamp(root)
    entry = cache.get(LISTS, {}).get(str(root)) if isinstance(cache.get(LISTS), dict) else None
    match entry:
        case [str(earlier), *names] if (
            stamp and earlier == stamp and all(isinstance(one, str) for one in names)
        ):
            return stamp, [Path(one) for one in names]
    return stamp, files_of(root)


def _input_file(label: str, path: Path, root: Path, listed: str, cache: Mapping[str, Any]) -> InputFile:
    """A file with its checksum; one that cannot be read fails when it is, and does not stop the others."""
    stamp = _stamp(path)
    match cache.get(str(path)):
        case [*numbers, str(checksum)] if checksum and tuple(numbers) == stamp:
            pass
        case _:
            try:
                with open_regular(path) as stream:
                    checksum = hashlib.file_digest(stream, "sha256").hexdigest()
            except OSError as error:
                checksum = f"cannot be read: {error.strerror}"
    return InputFile(label, path, checksum, stamp, root, listed)


def _stamp(path: Path) -> tuple[int, ...]:
    """Change of the content shows in one of these, also where size and time of modification are kept."""
    if not path.is_file():
        return ()
    status = path.stat()
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino
