"""Find the recordings under some folders and describe them; known ones are not read again."""

import hashlib
import logging
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, date, datetime, timedelta
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from irlos_pipe.conventions.errors import InputDataError, NothingToDo
from irlos_pipe.conventions.text import printable
from irlos_pipe.files.json import canonical_json, json_text
from irlos_pipe.files.processes import TookTooLong, time_limit
from irlos_pipe.instrument.instrument import PARANAL_DEG, Instrument
from irlos_pipe.night.database import Database
from irlos_pipe.readers import recorder
from irlos_pipe.readers.acquisition import Resolved
from irlos_pipe.readers.find import files_of, recording_files
from irlos_pipe.readers.sidecar import AcquisitionKeys, stated_instrument, stated_instruments
from irlos_pipe.stages.ingest.sources import read_sources

DATED = re.compile(r"(?<!\d)(20\d\d)-?([01]\d)-?([0-3]\d)(?!\d)")
DESCRIPTION_VERSION = 3  # version of what a description holds; files with an earlier one are read again
UNPRINTABLE = "{!r}: the name holds characters that cannot be shown; rename it"
BY_PATH, BY_FILE = "the date in its path", "the date of its file"
# Warnings of the readers are reported when the recording is reduced.
SILENT = logging.Logger("describe", logging.CRITICAL + 1)


@dataclass(frozen=True)
class Description:
    """What is known of a recording before it is reduced: enough to assign it to a night and a group."""

    path: Path  # the recorder's folder, or the file: the input that a recipe is given
    name: str
    role: str
    night: str  # date of its evening, ISO
    start_unix_s: float | None = None  # start time since 1970 [s]; None where the recording does not state it
    mode: str = ""  # read-out mode, empty where the file layout has none
    # What the NCPAs depend on: read-out mode, pixel scale, diversity. Recordings with equal text were taken
    # through the same optics.
    configuration: str = ""
    spectrum: str = ""  # wavelengths and weights
    window: tuple[int, int] = (0, 0)  # rows and columns [px]
    frames: int = 0
    target: str = ""
    exposure_s: float | None = None
    derotator_angle_deg: float = 0.0
    full_pupil: bool = True  # False for the images of a 2x2 mode
    content: str = ""  # checksum of the frames, the same for a copy
    night_by: str = ""  # what the night was taken from where the recording states no time; else empty

    def same_frames(self, other: "Description") -> bool:
        """Whether `other` holds the same frames, taken at the same time as far as that is known."""
        if not self.content or (self.content, self.mode) != (other.content, other.mode):
            return False
        known = self.start_unix_s is not None and other.start_unix_s is not None
        return not known or abs((self.start_unix_s or 0.0) - (other.start_unix_s or 0.0)) < 1.0

    def same_description(self, other: "Description") -> bool:
        """Whether `other` is said to be the same."""
        names = ("role", "configuration", "spectrum", "target", "exposure_s", "derotator_angle_deg")
        return all(getattr(self, name) == getattr(other, name) for name in names)


DESCRIPTION = TypeAdapter(Description)


@dataclass(frozen=True)
class LeftOut:
    """A recording that is not reduced, or what cannot be read as one; `alarming` if somebody should know."""

    recording: Description
    reason: str
    alarming: bool = False
    found_as: str = ""  # ``unusable`` or ``copy``, which is known before recordings are grouped; else empty


def discover(
    folders: Sequence[Path],
    keys: AcquisitionKeys,
    instrument: Instrument,
    database: Database,
    limit_s: float = 0.0,
) -> tuple[list[Description], list[LeftOut]]:
    """Return the recordings at any depth of the `folders`, and what is left out: copies, unusable files.

    One that cannot be read does not stop the others; a copy would count twice, in a ramp or as a second
    night's calibration. Side-car `keys` override the side-cars, the `instrument` has values of those that no
    side-car has. The `database` has descriptions of earlier runs; new ones are added. Reading one recording
    may take `limit_s`; there is no limit if that is 0.

    Raises `InputDataError` when one of the folders does not exist.
    """
    found: list[Description] = []
    problems: list[tuple[Path, str]] = []
    files = _files(folders, problems)
    # folders with exactly one recording in or below them
    counts = Counter(folder for file in files for folder in file.parents)
    single = {folder for folder, count in counts.items() if count == 1}
    for file in files:
        if not str(file).isprintable():  # nor is it opened: messages would hold the name
            problems.append((file, UNPRINTABLE.format(str(file))))
            continue
        try:
            with time_limit(limit_s, f"{file}: reading it"):
                found.append(_describe(file, file.parent in single, keys, instrument, database))
        except (InputDataError, TookTooLong) as error:
            problems.append((file, str(error)))
        except Exception as error:  # a damaged file must not keep the others from being read
            problems.append((file, f"{file}: unexpected {type(error).__name__}: {error}"))
    unusable = [_unusable(path, problem, found, instrument) for path, problem in problems]
    copies = {id(one.recording): one for one in _copies(found)}
    return [one for one in found if id(one) not in copies], [*unusable, *copies.values()]


def _unusable(path: Path, problem: str, found: Sequence[Description], instrument: Instrument) -> LeftOut:
    """Filed under the date in its path, else the night of the nearest recording, else that of the file."""
    nearest = max(found, key=lambda one: common_depth(one.path, path), default=None)
    night = date_in_path(path) or (nearest.night if nearest else _night_of_file(path, instrument))
    return LeftOut(Description(path, path.name, "", night), problem, alarming=True, found_as="unusable")


def _copies(found: Iterable[Description]) -> Iterator[LeftOut]:
    firsts: dict[str, list[Description]] = {}
    for one in found:
        others = firsts.setdefault(one.content, [])
        first = next((other for other in others if one.same_frames(other)), None)
        if first is None:
            others.append(one)
        elif one.same_description(first):
            yield LeftOut(one, f"a copy of {first.path}", found_as="copy")
        else:
            reason = f"the same frames as in {first.path}, but another side-car; remove one"
            yield LeftOut(one, reason, alarming=True, found_as="copy")


def known_recordings(database: Database) -> list[Description]:
    """Return the recordings of all nights in a `database` whose files still exist."""
    stored = (_stored(content) for file, content in database.descriptions() if Path(file).is_file())
    return list(filter(None, stored))


def night_of(unix_s: float, longitude_deg: float = PARANAL_DEG) -> str:
    """Return the night of a time [s since 1970]: ISO date of its evening; it ends at a site's local noon."""
    noon_utc = timedelta(hours=12 - longitude_deg / 15)
    return (datetime.fromtimestamp(unix_s, UTC) - noon_utc).date().isoformat()


def utc_time(unix_s: float | None, pattern: str = "%H:%M:%S") -> str:
    """Format the time of day of `unix_s` with a strftime `pattern`; return "" if it is not known."""
    return "" if unix_s is None else datetime.fromtimestamp(unix_s, UTC).strftime(pattern)


def common_depth(path: Path, other: Path) -> int:
    """Return how many leading folders `path` and `other` have in common."""
    pairs = zip(path.parts, other.parts, strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


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


def _describe(
    file: Path, single: bool, keys: AcquisitionKeys, instrument: Instrument, database: Database
) -> Description:
    """Describe the recording in a file; `single` if no other lies in its folder."""
    if not file.is_file():
        raise InputDataError(f"{file}: not a regular file, or a link to one that is gone")
    parts: list[Any] = [DESCRIPTION_VERSION, single, keys]
    for path in files_of(file):
        status = path.stat()
        parts += [path, status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino]
    stamp = canonical_json(parts)
    known = _stored(database.description(file, stamp))
    if known is not None:
        return known
    stated = stated_instruments([file])
    instrument = stated_instrument(stated)[1] if stated else instrument
    sources, failures = read_sources({"night": [file]}, lambda _: keys, instrument, SILENT)
    if failures:
        raise InputDataError(failures[0][1])
    description = _described(file, sources[0], single, instrument, instrument.name if stated else "")
    database.add_description(file, stamp, json_text(asdict(description), None))
    return description


def _stored(content: Any) -> Description | None:
    """A description from the database; None if there is none or it is damaged: the file is read again."""
    try:
        found = DESCRIPTION.validate_json(content or "")
        date.fromisoformat(found.night)  # the name of a folder is made of it
    except ValueError:
        return None
    return found


def _described(
    file: Path, source: Resolved, single: bool, instrument: Instrument, stated: str
) -> Description:
    raw, acquisition = source.raw, source.acquisition
    start = raw.start_unix_s if np.isfinite(raw.start_unix_s) else None
    diversity = ", ".join(f"Noll {noll} {nm:+g} nm" for noll, nm in sorted(acquisition.diversity.items()))
    scale = f"{acquisition.pixel_scale_mas:g} mas per pixel"
    optics = (stated, raw.mode, scale, acquisition.diversity_source, diversity)
    # of shape and values: the same whatever file the frames lie in
    frames = f"{raw.adu.shape} {raw.adu.dtype.kind}{raw.adu.dtype.itemsize}".encode() + raw.adu.tobytes()
    return Description(
        path=file.parent if raw.layout == recorder.LAYOUT and single else file,
        name=raw.name,
        role=acquisition.role,
        night=_night_of_file(file, instrument)
        if start is None
        else night_of(start, instrument.longitude_deg),
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
        content=hashlib.sha256(frames).hexdigest(),
    )


def _night_of_file(path: Path, instrument: Instrument) -> str:
    """The date in the path, else the night when the file was written."""
    return date_in_path(path) or night_of(path.stat().st_mtime, instrument.longitude_deg)
