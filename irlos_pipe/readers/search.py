"""Search a folder for FITS files: through all its depth, each folder and file once, whatever its links."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.readers.fitsfile import has_fits_name, stem

Refused = Callable[[Path, InputDataError], None]
Identity = tuple[int, int]  # device and inode
# Files of the real-time computer beside the frames: IRAcq.DET1.DARK.fits, IRCtr.SENSOR_2_MODES.fits
COMPUTER_FILE = re.compile(r"\w*(Acq|Ctr|Monitor|RTC|Recn)\.[\w.]+", re.ASCII)


def files_by_folder(root: Path, refused: Refused) -> Iterator[tuple[list[Path], list[Path]]]:
    """Yield the FITS and YAML files of a folder, then of each folder below it, in the natural order of names.

    Hidden files and folders, and those of the real-time computer, are left out. What is named like a FITS
    file is listed whatever it is; opening it says what is wrong.

    Parameters
    ----------
    root : Path
        The folder.
    refused : callable
        Called with each folder that may not be read, and the error.
    """
    for folder in sorted(_folders(root, refused), key=lambda folder: _place(folder, root)):
        files = [entry for entry in _entries(folder) if not entry.is_dir()]
        named = [file for file in files if has_fits_name(file) and not COMPUTER_FILE.fullmatch(stem(file))]
        yield named, [file for file in files if file.suffix == ".yaml" and file.is_file()]


def each_once(files: Iterable[Path]) -> list[Path]:
    """Return `files` without those that are another one under a second name; links give way."""
    files = list(dict.fromkeys(files))
    chosen: dict[object, Path] = {}
    for file in sorted(files, key=_is_linked):  # those without a link come first
        chosen.setdefault(_identity(file) or file, file)
    kept = set(chosen.values())
    return [file for file in files if file in kept]


def _is_linked(file: Path) -> bool:
    return os.path.realpath(file) != str(file)  # Path.resolve raises an error for links in a circle


def natural_order(path: Path) -> list:
    """Sort key that puts ``offset_2`` before ``offset_10``."""
    return [
        (1, int(part), "") if part.isdecimal() else (0, 0, part) for part in re.split(r"(\d+)", path.name)
    ]


def _folders(root: Path, refused: Refused) -> Iterator[Path]:
    """Folders without links to them first, so that a link never takes the place of the folder itself."""
    seen: set[Identity | None] = set()
    waiting = [root]
    links: list[Path] = []
    while waiting or links:
        folder = waiting.pop() if waiting else links.pop(0)
        if _identity(folder) in seen:
            continue
        seen.add(_identity(folder))
        if not os.access(folder, os.R_OK | os.X_OK):
            refused(folder, InputDataError(f"{folder}: no permission to read the folder"))
            continue
        yield folder
        below = [entry for entry in _entries(folder) if entry.is_dir()]
        waiting += [entry for entry in below if not entry.is_symlink()]
        links += [entry for entry in below if entry.is_symlink() and not _is_above(entry, root)]


def _is_above(link: Path, root: Path) -> bool:
    """Whether a link leads to a folder that holds the one that is searched."""
    return Path(os.path.realpath(root)).is_relative_to(os.path.realpath(link))


def _entries(folder: Path) -> list[Path]:
    return sorted((entry for entry in folder.iterdir() if not entry.name.startswith(".")), key=natural_order)


def _place(folder: Path, root: Path) -> list:
    return [natural_order(Path(part)) for part in folder.relative_to(root).parts]


def _identity(path: Path) -> Identity | None:
    """Return what is equal for all names of a file or folder; None where it is not there."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino
