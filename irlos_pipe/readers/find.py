"""Find the recordings under a path and read each with the reader of its layout."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from itertools import chain, count
from pathlib import Path

from irlos_pipe.conventions.errors import InputDataError, NothingToDo
from irlos_pipe.frames.raw import RawRecording
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers import aot, cube, muse_raw, recorder
from irlos_pipe.readers.fitsfile import has_fits_name, open_fits

LAYOUTS = (aot, recorder, muse_raw, cube)
DAMAGED = "damaged"
# Files of the real-time computer beside the frames: IRAcq.DET1.DARK.fits, IRCtr.SENSOR_2_MODES.fits
COMPUTER_FILE = re.compile(r"\w*(Acq|Ctr|Monitor|RTC|Recn)\.[\w.]+\.fits", re.ASCII)


def recording_files(
    paths: Sequence[Path], refused: Callable[[InputDataError], None] | None = None
) -> list[Path]:
    """Find the files with recordings among the given files and folders.

    Folders are searched through all their depth, in the natural order of names (2 before 10).
    A damaged FITS file counts as a recording: reading it will say what is wrong.

    Parameters
    ----------
    refused : callable, optional
        Told of folders below that may not be read; raised otherwise.

    Raises
    ------
    InputDataError
        A path that does not exist, is no FITS file, or may not be read.
    NothingToDo
        No recording under any of the paths.
    """
    files = [file for path in paths for file in _files_under(Path(path), refused or _raise)]
    if not files:
        raise NothingToDo(
            f"no recordings under {', '.join(map(str, paths)) or 'no path'}: neither SPARTA recorder "
            "folders nor FITS cubes"
        )
    return files


def read_recordings(path: Path, instrument: Instrument) -> list[RawRecording]:
    """Read the recordings of one FITS file, whatever its layout.

    Raises
    ------
    InputDataError
        No layout is recognised, or the file cannot be read.
    """
    match _layout(path):
        case aot.LAYOUT:
            return aot.read(path)
        case recorder.LAYOUT:
            return [recorder.read(path)]
        case muse_raw.LAYOUT:
            return muse_raw.read(path, instrument)
        case cube.LAYOUT:
            return [cube.read(path)]
    raise InputDataError(
        f"{path}: no recording in it; expected a table IRPixelFrame, an image SPARTA_TT_CUBE, "
        "a plain cube (frames, y, x), or an AOT file"
    )


def _layout(path: Path) -> str | None:
    """Name the layout of a FITS file, the most specific one that fits; None if it has no frames."""
    with open_fits(path) as hdus:
        return next((layout.LAYOUT for layout in LAYOUTS if layout.recognises(hdus)), None)


def _raise(error: InputDataError) -> None:
    raise error


def _files_under(path: Path, refused: Callable[[InputDataError], None]) -> Iterator[Path]:
    if not path.exists():
        raise InputDataError(f"{path}: no such file or folder")
    if path.is_dir():
        yield from _files_in_folder(path, refused)
    elif not has_fits_name(path):
        raise InputDataError(f"{path}: not a FITS file; give a FITS file, or a folder to search")
    else:
        yield path


def _files_in_folder(folder: Path, refused: Callable[[InputDataError], None]) -> Iterator[Path]:
    """Data files of a folder, then those of its subfolders; hidden ones are left out."""
    if not os.access(folder, os.R_OK | os.X_OK):
        refused(InputDataError(f"{folder}: no permission to read the folder"))
        return
    entries = sorted(
        (entry for entry in folder.iterdir() if not entry.name.startswith(".")), key=natural_order
    )
    candidates = [
        entry
        for entry in entries
        if entry.is_file() and has_fits_name(entry) and not COMPUTER_FILE.fullmatch(entry.name)
    ]
    yield from _data_files(candidates)
    for entry in entries:
        if entry.is_dir():
            yield from _files_in_folder(entry, refused)


def _data_files(candidates: list[Path]) -> list[Path]:
    """Files with frames in them; beside a pixel table other images are its telemetry, not cubes."""
    layouts = {path: _layout_or_damaged(path) for path in candidates}
    passed_over = {None, cube.LAYOUT} if recorder.LAYOUT in layouts.values() else {None}
    return [path for path, layout in layouts.items() if layout not in passed_over]


def _layout_or_damaged(path: Path) -> str | None:
    try:
        return _layout(path)
    except InputDataError:
        return DAMAGED


def natural_order(path: Path) -> list:
    """Sort key that puts ``offset_2`` before ``offset_10``."""
    return [
        (1, int(part), "") if part.isdecimal() else (0, 0, part) for part in re.split(r"(\d+)", path.name)
    ]


def unique_name(name: str, path: Path, taken: Collection[str]) -> str:
    """Return a name not yet taken, with the folder's name in front or a number behind if need be."""
    choices = chain(
        (name, f"{path.parent.name}-{name}", f"{path.parent.parent.name}-{name}"),
        (f"{name}-{number}" for number in count(2)),
    )
    return next(choice for choice in choices if choice not in taken)
