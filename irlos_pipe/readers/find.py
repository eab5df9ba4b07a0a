"""Find the recordings under a path and read each with the reader of its layout."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from typing import Protocol

from astropy.io import fits

from irlos_pipe.conventions.errors import InputDataError, NothingToDo
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers import aot, cube, muse_raw, recorder
from irlos_pipe.readers.fitsfile import file_header, has_fits_name, open_fits
from irlos_pipe.readers.inherited import inherited_cards
from irlos_pipe.readers.lone_sidecars import is_sidecar, lone_sidecars, what_lies_beside
from irlos_pipe.readers.raw_file import RawRecording
from irlos_pipe.readers.search import Refused, each_once, files_by_folder
from irlos_pipe.readers.sidecar import FOLDER_SIDECAR, own_sidecar, sidecar_path
from irlos_pipe.readers.times import start_of


class Reader(Protocol):
    """What a module that reads one layout offers."""

    LAYOUT: str

    def recognises(self, hdus: fits.HDUList) -> bool:
        """Return whether a FITS file has this layout; `hdus` may be used for their headers only."""

    def files_of(self, path: Path) -> list[Path]:
        """Return every file from which the recordings in `path` are read, but for the side-car."""

    def read(self, path: Path, hdus: fits.HDUList, instrument: Instrument) -> list[RawRecording]:
        """Read the recordings of a file.

        Parameters
        ----------
        path : Path
            The file, of which the other files of the recording are known.
        hdus : HDUList
            The file, open and checked.
        instrument : Instrument
            Knows the read-out modes.

        Raises
        ------
        InputDataError
            The file, or one that belongs to it, does not hold what the layout asks for.
        """


DAMAGED, TELEMETRY = "damaged", "telemetry"
READERS: tuple[Reader, ...] = (aot, recorder, muse_raw, cube)  # the most specific one that fits reads


def recording_files(paths: Sequence[Path], refused: Refused | None = None) -> list[Path]:
    """Find the files with recordings among the given files and folders.

    Folders are searched through all their depth, in the natural order of names (2 before 10); a file
    that several names and links lead to counts once. A damaged FITS file counts as a recording, and so
    does one without frames that a side-car describes, and a side-car without a data file: reading it will say
    what is wrong.

    Parameters
    ----------
    paths : sequence of Path
        Files and folders.
    refused : callable, optional
        Called with each folder below that may not be read, and the error; raised otherwise.

    Raises
    ------
    InputDataError
        A path that does not exist, is no FITS file, or may not be read.
    NothingToDo
        No recording under any of the paths.
    """
    files = each_once([file for path in paths for file in _files_under(Path(path), refused or _raise)])
    if not files:
        raise NothingToDo(
            f"no recordings under {', '.join(map(str, paths)) or 'no path'}: neither SPARTA recorder "
            "folders nor FITS cubes"
        )
    return files


def files_of(path: Path) -> list[Path]:
    """Return every file from which the recordings in `path` are read: data, calibration images, side-car."""
    own = [path]
    with suppress(InputDataError):  # reading will say what is wrong
        reader = _reader_of(path)
        own = [path] if reader is None else reader.files_of(path)
    return [*own, *filter(Path.is_file, [sidecar_path(path)])]


def read_recordings(path: Path, instrument: Instrument) -> list[RawRecording]:
    """Read the recordings of the FITS file `path`, whatever its layout; the `instrument` knows the modes.

    Raises
    ------
    InputDataError
        No layout is recognised, or the file cannot be read.
    """
    if is_sidecar(path):
        raise InputDataError(what_lies_beside(path))
    notes: list[str] = []
    with open_fits(path, notes=notes) as hdus:
        reader = _recognised(hdus)
        if reader is not None:
            header = file_header(hdus)
            cards, start = inherited_cards(header), start_of(header)
            return [
                replace(
                    raw,
                    cards=cards,
                    warnings=(*notes, *raw.warnings),
                    start_unix_s=raw.start_unix_s if math.isfinite(raw.start_unix_s) else start,
                )
                for raw in reader.read(path, hdus, instrument)
            ]
    raise InputDataError(
        f"{path}: no recording in it; expected a table IRPixelFrame, an image SPARTA_TT_CUBE, "
        "a plain cube (frames, y, x), or an AOT file"
    )


def _recognised(hdus: fits.HDUList) -> Reader | None:
    return next((reader for reader in READERS if reader.recognises(hdus)), None)


def _reader_of(path: Path) -> Reader | None:
    """Return the reader of a FITS file, judged by its headers; None if it has no frames."""
    with open_fits(path, verify=False) as hdus:
        return _recognised(hdus)


def _raise(folder: Path, error: InputDataError) -> None:
    raise error


def _files_under(path: Path, refused: Refused) -> Iterator[Path]:
    if not path.exists():
        raise InputDataError(f"{path}: no such file or folder")
    if path.is_dir():
        folders = [(_data_files(named), named, yaml) for named, yaml in files_by_folder(path, refused)]
        with_data = {folder for files, _, _ in folders for file in files for folder in file.parents}
        for files, named, yaml in folders:
            yield from files
            yield from lone_sidecars(yaml, named, with_data)
        return
    if not has_fits_name(path) and not is_sidecar(path):
        with open_fits(path, verify=False):  # whatever its name, if it is one
            pass
    yield path


def _data_files(candidates: list[Path]) -> list[Path]:
    """Files of a folder with frames, or that should have some."""
    layouts = {path: _layout(path) for path in candidates}
    recorded = recorder.LAYOUT in layouts.values()
    return [path for path, layout in layouts.items() if _is_data(path, layout, recorded)]


def _is_data(path: Path, layout: str | None, beside_pixel_table: bool) -> bool:
    """Whether a file is a recording; one that a side-car describes is, if only a damaged one."""
    if layout == TELEMETRY:
        return False
    if own_sidecar(path).is_file():
        return True
    if beside_pixel_table:  # other images are its telemetry, not cubes
        return layout not in (None, cube.LAYOUT)
    return layout is not None or path.with_name(FOLDER_SIDECAR).is_file()


def _layout(path: Path) -> str | None:
    """Name the layout of a FITS file; None if it has no frames."""
    try:
        with open_fits(path, verify=False) as hdus:
            reader, telemetry = _recognised(hdus), recorder.is_telemetry(hdus)
    except InputDataError:
        return DAMAGED
    return reader.LAYOUT if reader is not None else TELEMETRY if telemetry else None


def unique_name(name: str, path: Path, taken: Collection[str]) -> str:
    """Return `name` if it is not yet `taken`, else with the name of the folder of `path` or a number."""
    choices = chain(
        (name, f"{path.parent.name}-{name}", f"{path.parent.parent.name}-{name}"),
        (f"{name}-{number}" for number in count(2)),
    )
    return next(choice for choice in choices if choice not in taken)
