"""A folder into which a recorder writes: every recording that appears is read once it is complete."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from irlos_pipe.control.exposures import Read
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.focus.source import Fault
from irlos_pipe.frames.cleaning import find_background
from irlos_pipe.frames.detector import to_electrons
from irlos_pipe.frames.recording import Detector
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers.calibration_files import PREFIX
from irlos_pipe.readers.find import read_recordings
from irlos_pipe.readers.fitsfile import has_fits_name
from irlos_pipe.readers.raw_file import RawRecording

POLL_S = 0.02
QUIET_S = 0.2  # a file that has not changed for so long is complete


class WatchedFolder:
    """Recorder folders and FITS files below a folder, one level deep, see `Source`.

    Parameters
    ----------
    root : Path
    instrument : Instrument
        Knows the read-out modes.
    detector : Detector
        Its gain.
    from_start : bool
        Read what is there already, too.

    Raises
    ------
    InputDataError
        If there is no such folder.
    """

    def __init__(self, root: Path, instrument: Instrument, detector: Detector, *, from_start: bool = False):
        if not root.is_dir():
            raise InputDataError(f"{root}: no such folder; give the one that the recorder writes to")
        self._root, self._instrument, self._detector = root, instrument, detector
        self._seen: dict[Path, tuple[int, int]] = {}
        self._read = set() if from_start else set(self._files())
        self._away = False

    def poll(self, timeout_s: float) -> Sequence[Read | Fault]:
        """See `Source.poll`."""
        until = time.monotonic() + timeout_s
        while True:
            try:
                complete = self._complete()
            except OSError as error:
                return self._gone(error, until)
            self._away = False
            if complete or time.monotonic() >= until:
                return [read for path in complete for read in self._reads(path)]
            time.sleep(POLL_S)

    def close(self) -> None:
        """See `Source.close`."""

    def _gone(self, error: OSError, until: float) -> list[Fault]:
        """A folder that cannot be read, an unmounted disk say: named once, and waited for."""
        first, self._away = not self._away, True
        time.sleep(max(0.0, until - time.monotonic()))
        return [Fault(f"{self._root}: cannot be read: {error.strerror}")] if first else []

    def _files(self) -> list[Path]:
        """FITS files with frames, by name: in the order in which recorders number them."""
        folders = [self._root, *(one for one in self._root.iterdir() if one.is_dir() and one.name[0] != ".")]
        files = (file for folder in folders for file in folder.iterdir())
        return sorted(f for f in files if has_fits_name(f) and not f.name.startswith((PREFIX, ".")))

    def _complete(self) -> list[Path]:
        """New files that no longer change."""
        found = []
        for path in self._files():
            if path in self._read:
                continue
            try:
                stat = path.stat()
            except OSError:  # taken away meanwhile
                continue
            state = stat.st_size, stat.st_mtime_ns
            if self._seen.get(path) == state and time.time_ns() - stat.st_mtime_ns > QUIET_S * 1e9:
                found.append(path)
                self._read.add(path)
                self._seen.pop(path)
            else:
                self._seen[path] = state
        return found

    def _reads(self, path: Path) -> list[Read | Fault]:
        try:
            recordings = read_recordings(path, self._instrument)
        except InputDataError as error:
            return [Fault(" ".join(str(error).split()))]
        except Exception as error:  # nobody foresees all that can stand in a file
            return [Fault(f"{path}: cannot be used: {type(error).__name__}: {error}")]
        return [read for raw in recordings for read in self._frames(raw)]

    def _frames(self, raw: RawRecording) -> list[Read]:
        good = ~raw.calibration.bad if raw.calibration.bad is not None else np.ones(raw.window, bool)
        background = find_background(raw.adu, raw.calibration, good)
        images = to_electrons(raw.adu, background.adu, background.flat, self._detector.e_per_adu)
        times = np.full(raw.frames, np.nan) if raw.unix_s is None else raw.unix_s
        return [
            Read(int(counter), float(unix_s), image)
            for counter, unix_s, image in zip(raw.frame_counter, times, images, strict=True)
        ]
