"""Frames from files: those of a run once more, or of recordings that appear in a folder."""

import math
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from irlos_pipe.control.exposures import Read
from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.focus.calibration import stated_detector, stated_differences
from irlos_pipe.focus.journal import Earlier
from irlos_pipe.focus.source import Arrival, Fault, Notice
from irlos_pipe.frames.cleaning import find_background, to_electrons
from irlos_pipe.frames.recording import Acquisition, picked
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.product.runfolder import existing_run
from irlos_pipe.product.storage import open_product
from irlos_pipe.readers.acquisition import RawRecording
from irlos_pipe.readers.find import read_recordings
from irlos_pipe.readers.fitsfile import has_fits_name
from irlos_pipe.readers.recorder import PREFIX
from irlos_pipe.readers.sidecar import read_sidecar, sidecar_path, stated_instrument, stated_instruments
from irlos_pipe.readers.times import relative_times
from irlos_pipe.recipe.load import load_recipe
from irlos_pipe.stages.model.effects import used_in_time_order

LONGEST_WAIT_S = 3600.0  # longest wait of a replay for its next frame
POLL_S = 0.02  # between looks at what has been read
PART = "#"  # between the name of a file and that of one of its recordings
QUIET_S = 0.2  # a file that has not changed for so long is complete
LARGEST_BYTES = 1 << 30  # largest file that is read: half an hour of 64 reads a second of 64x64 px
State = tuple[int, int, int]  # of a file: its size, when it changed, and when its side-car did
PATIENCE_S, TOLD_S, GIVEN_UP_S = 1.0, 5.0, 60.0  # a poll waits for reading; it is reported; it is given up


class Replay:
    """Used frames of one input of a run as the stage `lift` gets them, in order of time; counted from 0.

    They come at `speed` times the rate at which they were taken; 0 is as fast as they can be measured.

    Raises `InputDataError` if the run has no such input.
    """

    def __init__(self, run: Path, input_name: str, speed: float = 0.0):
        run_folder = existing_run(run)
        path = run_folder.products().get("ingest")
        if path is None:
            raise InputDataError(f"{run}: holds no ingested frames; run its recipe again")
        try:
            recordings = used_in_time_order(open_product(path), input_name)
        except (KeyError, IndexError):
            recordings = []
        if not recordings:
            raise InputDataError(f"{run}: has no input '{input_name}' with frames")
        self.window, self.acquisition = recordings[0].window, recordings[0].acquisition
        self.instrument_name = load_recipe(run_folder.recipe, needed="none").instrument_name
        frames = (
            (one.start_unix_s + float(time_s), image_e)
            for one in recordings
            for time_s, image_e in zip(one.time_s, one.images_e, strict=True)
        )
        self._reads = (Read(number, *frame) for number, frame in enumerate(frames))
        self._speed, self._started, self._first_s = speed, time.monotonic(), math.nan

    def poll(self, timeout_s: float) -> Sequence[Read] | None:
        read = next(self._reads, None)
        if read is None:
            return None
        if self._speed > 0 and not math.isnan(read.unix_s):
            self._first_s = read.unix_s if math.isnan(self._first_s) else self._first_s
            due = self._started + (read.unix_s - self._first_s) / self._speed
            time.sleep(min(max(0.0, due - time.monotonic()), LONGEST_WAIT_S))
        return [read]

    def close(self) -> None:
        """See `Source.close`."""


class WatchedFolder:
    """Recorder folders and FITS files below a folder, one level deep, each read once it is complete.

    Of one that changes after that, as a slow recorder or a stalled copy lets it, the frames beyond those that
    were read follow. Every recording counts its frames by itself: they carry its name, of the file below the
    folder. One whose side-car contradicts the acquisition is not used. What has come since an earlier loop is
    read; without one, what is there already is not.

    Raises `InputDataError` if there is no such folder.
    """

    def __init__(
        self, root: Path, instrument: Instrument, acquisition: Acquisition, earlier: Earlier | None = None
    ):
        if not root.is_dir():
            raise InputDataError(f"{root}: no such folder; give the one that the recorder writes to")
        self._root, self._instrument, self._calibrated = root, instrument, acquisition
        self._seen: dict[Path, tuple[State, float]] = {}
        self._due, self._reading = list[Path](), _Reading()
        self._earlier = earlier or Earlier()
        # files that are read, as they were then; None: they are not ours
        self._read = dict.fromkeys(
            one for one in self._files() if earlier is None or self._is_done(one, earlier)
        )
        self._taken: dict[str, tuple[int, int]] = {}  # of each recording: frames, and when its file changed
        self._away = False

    def poll(self, timeout_s: float) -> Sequence[Arrival]:
        until = time.monotonic() + timeout_s
        while True:
            try:
                self._due += self._complete()
            except OSError as error:
                return self._gone(error, until)
            self._away = False
            if (found := self._next()) or time.monotonic() >= until:
                return found
            time.sleep(POLL_S)

    def close(self) -> None:
        """See `Source.close`."""

    def _next(self) -> list[Arrival]:
        """What the files that are due hold, as far as they are read: one after the other, in a thread."""
        found: list[Arrival] = []
        while True:
            found += self._reading.news()
            if self._reading.thread is not None or not self._due:
                return found
            self._reading = _Reading(self._due.pop(0), self._reads)

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

    def _is_done(self, path: Path, earlier: Earlier) -> bool:
        """Whether an earlier loop has read a file, or it was there before that; the last may be half done."""
        name = self._name(path)
        if name == earlier.last.partition(PART)[0]:
            return False
        try:  # the time of the change: copies keep that of their contents
            came_unix_s = path.stat().st_ctime
        except OSError:
            return False
        done = {one.partition(PART)[0] for one in earlier.recordings}
        return came_unix_s < earlier.since_unix_s or name in done

    def _name(self, path: Path) -> str:
        return path.relative_to(self._root).as_posix()

    def _complete(self) -> list[Path]:
        """New files that no longer change; the last one of an earlier loop comes first."""
        found = []
        for path in sorted(self._files(), key=lambda one: self._name(one) != self._earlier.last):
            if path in self._read and self._read[path] is None:
                continue
            try:
                stat = path.stat()
            except OSError:  # taken away meanwhile
                continue
            state, now_s = (stat.st_size, stat.st_mtime_ns, _changed_ns(sidecar_path(path))), time.monotonic()
            if self._read.get(path) == state:
                continue
            before, since_s = self._seen.get(path, (None, now_s))
            if state != before:
                self._seen[path] = state, now_s
            elif max(now_s - since_s, time.time() - stat.st_mtime) > QUIET_S:  # it may be dated ahead
                found.append(path)
                self._read[path] = state
                self._seen.pop(path)
        return found

    def _reads(self, path: Path) -> list[Read | Fault]:
        found: list[Read | Fault] = []
        try:
            if (size := path.stat().st_size) > LARGEST_BYTES:
                return [Fault(f"{path}: {size / 2**30:.1f} GiB, more than a recording has; not read")]
            recordings = read_recordings(path, self._instrument)
            for raw in recordings:
                name = self._name(path) + (f"{PART}{raw.name}" if len(recordings) > 1 else "")
                if name == self._earlier.last or name not in self._earlier.recordings:
                    found += self._reads_of(raw, name)
        except InputDataError as error:
            found.append(Fault(" ".join(str(error).split())))
        except Exception as error:  # what a file can contain is not foreseeable
            found.append(Fault(f"{path}: cannot be used: {type(error).__name__}: {error}"))
        return found

    def _reads_of(self, raw: RawRecording, name: str) -> list[Read] | list[Fault]:
        """New frames of a recording, unless its side-car says that they are not those of the calibration."""
        path, changed_ns = sidecar_path(raw.path), _changed_ns(raw.path)
        taken, then_ns = self._taken.get(name, (0, changed_ns))
        keys = read_sidecar(path)
        against = stated_differences(keys, self._calibrated)
        if stated := stated_instruments([raw.path]):
            other, instrument, _ = stated_instrument(stated)
            against += [] if instrument == self._instrument else [f"instrument {other}"]
        if against:
            before = f"; it came late: {taken} frames have been used" if taken else ""
            return [
                Fault(f"{path}: not taken as the calibration says: {'; '.join(against)}; not used{before}")
            ]
        if 0 < raw.frames <= taken:
            told = f"{raw.path}: changed, with no more frames than were read; they are not read again"
            return [Fault(told)] if changed_ns != then_ns else []
        good = ~raw.calibration.bad if raw.calibration.bad is not None else np.ones(raw.window, bool)
        finite = np.isfinite(raw.adu)
        good = good & (finite.any(axis=0) | ~finite.any())
        whole = picked(raw.adu, finite[:, good].all(axis=1))
        background = find_background(whole if len(whole) else np.nan_to_num(raw.adu), raw.calibration, good)
        detector = stated_detector(keys, self._calibrated)
        images = to_electrons(raw.adu, background.adu, background.flat, detector.e_per_adu)
        if detector.saturation_adu is not None:
            images[raw.adu >= detector.saturation_adu] = np.inf
        times = np.full(raw.frames, changed_ns / 1e9)  # no frame is younger
        if math.isfinite(raw.start_unix_s):
            rate_hz = keys.frame_rate_hz or self._calibrated.frame_rate_hz
            times = raw.start_unix_s + relative_times(raw.unix_s, raw.frame_counter, rate_hz)
        self._taken[name] = raw.frames, changed_ns
        reads = zip(raw.frame_counter[taken:], times[taken:], images[taken:], strict=True)
        return [Read(int(counter), float(unix_s), image, name) for counter, unix_s, image in reads]


def _changed_ns(path: Path) -> int:
    """When a file changed; 0 where there is none."""
    try:
        return path.stat().st_mtime_ns
    except (FileNotFoundError, NotADirectoryError):  # perhaps taken away just now
        return 0


class _Reading:
    """A file that is being read, and waited for while `thread` is there; without one, none."""

    thread: threading.Thread | None = None

    def __init__(self, path: Path | None = None, read: Callable[[Path], list[Read | Fault]] | None = None):
        self._path, self._began_s, self._reported = path, time.monotonic(), False
        self._found: list[Read | Fault] = []
        if path is not None and read is not None:
            self.thread = threading.Thread(target=lambda: self._found.extend(read(path)), daemon=True)
            self.thread.start()
            self.thread.join(PATIENCE_S)

    def news(self) -> list[Arrival]:
        """Return what it holds, once, or that it takes long; after a minute it is given up."""
        lasts_s = time.monotonic() - self._began_s
        if self.thread is None:
            return []
        if not self.thread.is_alive():
            self.thread = None
            return list(self._found)
        if lasts_s > GIVEN_UP_S:
            self.thread = None
            return [Fault(f"{self._path}: given up after reading for {lasts_s:.0f} s")]
        if lasts_s > TOLD_S and not self._reported:
            self._reported = True
            return [Notice(f"reading {self._path} since {lasts_s:.0f} s")]
        return []
