"""Find the recordings under some folders and describe them; known ones are not read again."""

from __future__ import annotations

import hashlib
import logging
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import InputDataError, NothingToDo
from irlos_pipe.conventions.text import printable
from irlos_pipe.files.json import canonical_json
from irlos_pipe.files.time_limit import TookTooLong, time_limit
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.night.database import Database
from irlos_pipe.night.description import Description, common_depth, night_of
from irlos_pipe.readers import recorder
from irlos_pipe.readers.find import files_of, recording_files
from irlos_pipe.readers.sidecar import AcquisitionKeys
from irlos_pipe.stages.ingest.sources import Source, read_sources

DATED = re.compile(r"(?<!\d)(20\d\d)-?([01]\d)-?([0-3]\d)(?!\d)")
DESCRIPTION_VERSION = 3  # of what a description holds; those of an earlier one are read anew
UNPRINTABLE = "{!r}: the name holds characters that cannot be shown; rename it"
BY_PATH, BY_FILE = "the date in its path", "the date of its file"
# Warnings of the readers are reported when the recording is reduced.
SILENT = logging.Logger("describe", logging.CRITICAL + 1)


@dataclass(frozen=True)
class Unusable:
    """A file or folder that cannot be used, the night that it most likely belongs to, and why."""

    path: Path
    night: str
    problem: str


@dataclass(frozen=True)
class Copy:
    """A recording whose frames are those of another one, and which that is."""

    recording: Description
    of: Description


@dataclass(frozen=True)
class Discovered:
    """The recordings found, copies of them, and what cannot be used."""

    recordings: list[Description] = field(default_factory=list)
    unusable: list[Unusable] = field(default_factory=list)
    copies: list[Copy] = field(default_factory=list)


def discover(
    folders: Sequence[Path],
    keys: AcquisitionKeys,
    instrument: Instrument,
    database: Database,
    limit_s: float = 0.0,
) -> Discovered:
    """Describe every recording under the folders; one that cannot be read does not stop the others.

    Parameters
    ----------
    folders : sequence of Path
        Searched through all their depth.
    keys : AcquisitionKeys
        Side-car keys that override the side-cars.
    instrument : Instrument
        Values of the keys that no side-car has.
    database : Database
        Descriptions of earlier runs; new ones are added.
    limit_s : float
        Longest time for reading one recording [s]; no limit if 0.

    Raises
    ------
    InputDataError
        When one of the folders does not exist.
    """
    recordings: list[Description] = []
    problems: list[tuple[Path, str]] = []
    files = _files(folders, problems)
    single = _single_recording_folders(files)
    for file in files:
        if not str(file).isprintable():  # nor is it opened: messages would hold the name
            problems.append((file, UNPRINTABLE.format(str(file))))
            continue
        try:
            with time_limit(limit_s, f"{file}: reading it"):
                recordings.append(_describe(file, file.parent in single, keys, instrument, database))
        except (InputDataError, TookTooLong) as error:
            problems.append((file, str(error)))
        except Exception as error:  # a damaged file must not keep the others from being read
            problems.append((file, f"{file}: unexpected {type(error).__name__}: {error}"))
    unusable = [Unusable(path, _night_of_unusable(path, recordings), problem) for path, problem in problems]
    return Discovered(*_without_copies(recordings, unusable))


def _without_copies(
    found: Sequence[Description], unusable: list[Unusable]
) -> tuple[list[Description], list[Unusable], list[Copy]]:
    """Each recording once: a copy would count twice, in a ramp or as a second night's calibration."""
    firsts: dict[str, list[Description]] = {}
    copies: list[Copy] = []
    for one in found:
        others = firsts.setdefault(one.content, [])
        first = next((other for other in others if one.same_frames(other)), None)
        if first is None:
            others.append(one)
        else:
            copies.append(Copy(one, first))
    left_out = {id(copy.recording) for copy in copies}
    return [one for one in found if id(one) not in left_out], unusable, copies


def date_in_path(path: Path) -> str:
    """Return the date in the name of a folder, or of the nearest one above that has one (ISO); else ""."""
    for part in reversed(path.parts):
        for year, month, day in DATED.findall(part):
            try:
                return date(int(year), int(month), int(day)).isoformat()
            except ValueError:
                continue
    return ""


def _files(folders: Sequence[Path], problems: list[tuple[Path, str]]) -> list[Path]:
    def refused(folder: Path, error: InputDataError) -> None:
        problems.append((folder, printable(str(error))))

    try:
        return list(dict.fromkeys(recording_files([folder.absolute() for folder in folders], refused)))
    except NothingToDo:
        return []


def _single_recording_folders(files: Iterable[Path]) -> set[Path]:
    """Folders with exactly one recording in or below them."""
    counts = Counter(folder for file in files for folder in file.parents)
    return {folder for folder, count in counts.items() if count == 1}


def _describe(
    file: Path, single: bool, keys: AcquisitionKeys, instrument: Instrument, database: Database
) -> Description:
    """Describe the recording in a file; `single` if no other lies in its folder."""
    if not file.is_file():
        raise InputDataError(f"{file}: not a regular file, or a link to one that is gone")
    stamp = _stamp(file, keys, single)
    known = database.description(file, stamp)
    if known is not None:
        return known
    sources, failures = read_sources({"night": [file]}, lambda _: keys, instrument, SILENT)
    if failures:
        raise InputDataError(failures[0][1])
    description = _described(file, sources[0], single)
    database.add_description(file, stamp, description)
    return description


def _described(file: Path, source: Source, single: bool) -> Description:
    raw, acquisition = source.raw, source.resolved.acquisition
    start = raw.start_unix_s if np.isfinite(raw.start_unix_s) else None
    diversity = ", ".join(f"Noll {noll} {nm:+g} nm" for noll, nm in sorted(acquisition.diversity.items()))
    scale = f"{acquisition.pixel_scale_mas:g} mas per pixel"
    optics = (raw.mode, scale, acquisition.diversity_source, diversity)
    return Description(
        path=file.parent if raw.layout == recorder.LAYOUT and single else file,
        name=raw.name,
        role=acquisition.role,
        night=_night_of_file(file) if start is None else night_of(start),
        night_by="" if start is not None else BY_PATH if date_in_path(file) else BY_FILE,
        start_unix_s=start,
        mode=raw.mode,
        configuration=", ".join(filter(None, optics)),
        spectrum=", ".join(f"{wavelength:g} nm ({weight:g})" for wavelength, weight in acquisition.spectrum),
        window=raw.window,
        frames=raw.frames,
        target=acquisition.target,
        exposure_s=acquisition.exposure_s,
        derotator_angle_deg=acquisition.derotator_angle_deg,
        full_pupil=raw.lenslets == 1,
        content=_checksum(raw.adu),
    )


def _checksum(adu: np.ndarray) -> str:
    """Of shape and values: the same whatever file the frames lie in."""
    head = f"{adu.shape} {adu.dtype.kind}{adu.dtype.itemsize}"
    return hashlib.sha256(head.encode() + np.ascontiguousarray(adu).tobytes()).hexdigest()


def _night_of_file(path: Path) -> str:
    """The date in the path, else the night when the file was written."""
    return date_in_path(path) or night_of(path.stat().st_mtime)


def _night_of_unusable(path: Path, recordings: Sequence[Description]) -> str:
    """The date in the path, else the night of the recording nearest in the folder tree, else of the file."""
    nearest = max(recordings, key=lambda one: common_depth(one.path, path), default=None)
    return date_in_path(path) or (nearest.night if nearest else _night_of_file(path))


def _stamp(file: Path, keys: AcquisitionKeys, single: bool) -> str:
    """Everything that the description depends on: settings, and sizes and times of the files."""
    parts: list[Any] = [DESCRIPTION_VERSION, single, keys]
    for path in files_of(file):
        status = path.stat()
        parts += [path, status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]
    return canonical_json(parts)
