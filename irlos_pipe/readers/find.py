"""Find the recordings under a path and read each with the reader of its layout.

A folder is searched through all its depth, each folder and file once, whatever its links.
"""

import math
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from typing import Protocol, get_args

from astropy.io import fits

from irlos_pipe.conventions.errors import InputDataError, NothingToDo
from irlos_pipe.conventions.text import printable
from irlos_pipe.files.regular import open_regular
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers import aot, cube, muse_raw, recorder
from irlos_pipe.readers.acquisition import RawRecording, inherited_cards
from irlos_pipe.readers.fitsfile import file_header, has_fits_name, open_fits, stem
from irlos_pipe.readers.sidecar import FOLDER_SIDECAR, Role, own_sidecar, sidecar_path
from irlos_pipe.readers.times import start_of

Refused = Callable[[Path, InputDataError], None]
Identity = tuple[int, int]  # device and inode
# Files of the real-time computer next to the frames: IRAcq.DET1.DARK.fits, IRCtr.SENSOR_2_MODES.fits
COMPUTER_FILE = re.compile(r"\w*(Acq|Ctr|Monitor|RTC|Recn)\.[\w.]+", re.ASCII)
# What distinguishes a side-car from recipes, profiles and other YAML files: the key that each must have.
ROLE = re.compile(rf"^role[ \t]*:[ \t]*['\"]?({'|'.join(get_args(Role))})\b".encode(), re.MULTILINE)
LOOKED_AT_BYTES = 2**16
SHOWN_NAMES = 3

DAMAGED, TELEMETRY = "damaged", "telemetry"


class Reader(Protocol):
    """What a module that reads one layout offers.

    One that reads further files for a recording has ``files_of(path)``, which returns all but the side-car.
    """

    LAYOUT: str

    def recognises(self, hdus: fits.HDUList) -> bool:
        """Return whether a FITS file has this layout; `hdus` may be used for their headers only."""

    def read(self, path: Path, hdus: fits.HDUList, instrument: Instrument) -> list[RawRecording]:
        """Read the recordings of the file `path`, of which the other files of the recording are known.

        The `hdus` are open and checked; the `instrument` knows the read-out modes.

        Raises `InputDataError` where the file, or one that belongs to it, does not hold what the layout asks
        for.
        """


READERS: tuple[Reader, ...] = (aot, recorder, muse_raw, cube)  # the most specific one that fits reads


def recording_files(paths: Sequence[Path], refused: Refused | None = None) -> list[Path]:
    """Find the files with recordings among the files and folders `paths`.

    Folders are searched through all their depth, in the natural order of names (2 before 10); a file that
    several names and links lead to counts once. A damaged FITS file counts as a recording, and so does one
    without frames that a side-car describes, and a side-car without a data file: reading it will say what is
    wrong. `refused` is called with each folder below that may not be read, and the error, which is raised
    otherwise.

    Raises `InputDataError` for a path that does not exist, is no FITS file, or may not be read, and
    `NothingToDo` where no path has a recording.
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
        with open_fits(path, verify=False) as hdus:
            reader = _recognised(hdus)
        own = getattr(reader, "files_of", lambda one: [one])(path)
    return [*own, *filter(Path.is_file, [sidecar_path(path)])]


def read_recordings(path: Path, instrument: Instrument) -> list[RawRecording]:
    """Read the recordings of the FITS file `path`, whatever its layout; the `instrument` knows the modes.

    Raises `InputDataError` where no layout is recognised, or the file cannot be read.
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


def files_by_folder(root: Path, refused: Refused) -> Iterator[tuple[list[Path], list[Path]]]:
    """Yield the FITS and YAML files of `root`, then of each folder below it, in the natural order of names.

    Hidden files and folders, and those of the real-time computer, are left out. What is named like a FITS
    file is listed whatever it is; opening it says what is wrong. `refused`: see `recording_files`.
    """

    def place(folder: Path) -> list:
        return [natural_order(Path(part)) for part in folder.relative_to(root).parts]

    for folder in sorted(_folders(root, refused), key=place):
        files = [entry for entry in _entries(folder) if not entry.is_dir()]
        named = [file for file in files if has_fits_name(file) and not COMPUTER_FILE.fullmatch(stem(file))]
        yield named, [file for file in files if file.suffix == ".yaml" and file.is_file()]


def each_once(files: Iterable[Path]) -> list[Path]:
    """Return `files` without those that are another one under a second name; links give way."""
    files = list(dict.fromkeys(files))
    chosen: dict[object, Path] = {}
    # those without a link come first; Path.resolve raises an error for links in a circle
    for file in sorted(files, key=lambda one: os.path.realpath(one) != str(one)):
        chosen.setdefault(_identity(file) or file, file)
    kept = set(chosen.values())
    return [file for file in files if file in kept]


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


def _identity(path: Path) -> Identity | None:
    """Return what is equal for all names of a file or folder; None where it is not there."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


def is_sidecar(path: Path) -> bool:
    """Return whether a file is a side-car, by its name or by what it holds."""
    if path.suffix != ".yaml" or not path.is_file():
        return False
    if path.name == FOLDER_SIDECAR:
        return True
    try:
        with open_regular(path) as stream:
            return ROLE.search(stream.read(LOOKED_AT_BYTES)) is not None
    except OSError:
        return False


def lone_sidecars(sidecars: Sequence[Path], named: Sequence[Path], with_data: Collection[Path]) -> list[Path]:
    """Return those of the `sidecars` of a folder that describe nothing.

    `named` are its files that are named like FITS files, `with_data` the folders with a recording, in them or
    below.
    """
    stems = {stem(file) for file in named}
    return [
        path
        for path in sidecars
        if (path.parent not in with_data if path.name == FOLDER_SIDECAR else path.stem not in stems)
        and is_sidecar(path)
    ]


def what_lies_beside(sidecar: Path) -> str:
    """Return a line that says that a side-car is no recording, and what lies next to it."""
    own = sidecar.parent.name if sidecar.name == FOLDER_SIDECAR else sidecar.stem
    others = sorted(one.name for one in sidecar.parent.iterdir() if one != sidecar and one.name[0] != ".")
    names = [name for name in others if name.startswith(own)] or others
    more = f" and {len(names) - SHOWN_NAMES} more" if len(names) > SHOWN_NAMES else ""
    nearby = (
        f"beside it: {printable(', '.join(names[:SHOWN_NAMES]))}{more}" if names else "nothing lies beside it"
    )
    return (
        f"{sidecar}: a side-car, and no recording that could be read belongs to it; {nearby}; "
        "complete the recording, or remove the side-car"
    )
