"""What ingest starts from: the recordings of all inputs, each with what is known about it."""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from irlos_pipe.conventions.errors import InputDataError, NothingToDo
from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.conventions.reads import adds_up
from irlos_pipe.conventions.units import MAS_PER_RAD, NM, resolution_px
from irlos_pipe.frames.recording import Recording, mean_frame
from irlos_pipe.frames.told import mean_variance
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers import find
from irlos_pipe.readers.acquisition import RawRecording, Resolved, resolve
from irlos_pipe.readers.find import read_recordings, recording_files, unique_name
from irlos_pipe.readers.sidecar import AcquisitionKeys, sidecar_path, sidecar_problems
from irlos_pipe.readers.times import counter_step
from irlos_pipe.stages.ingest.stage import Config

OTHER_EXPOSURE = 0.01  # relative difference from which the exposure of a dark is another
SHORT_COUNTS = 2  # bytes of the counts of a converter, which saturate with their type; sums of them do not


def read_sources(
    inputs: Mapping[str, Sequence[Path]],
    keys_for: Callable[[str], AcquisitionKeys],
    instrument: Instrument,
    log: logging.Logger,
) -> tuple[list[Resolved], list[tuple[str, str]]]:
    """Read all recordings of all `inputs`, files and folders by input name.

    Side-car keys from the recipe, ``keys_for(input_name)``, win; the profile of the `instrument` gives the
    values that are stated nowhere else. Returned with the sources are (input name, reason) of recordings that
    cannot be read; the others go on without them. Raises NothingToDo for an input without recordings.
    """
    sources: list[Resolved] = []
    failures: list[tuple[str, str]] = []
    for name, paths in inputs.items():
        taken: set[str] = set()
        own: list[Resolved] = []
        for file in recording_files(paths):
            with failing_alone(failures, name, file, log):
                for read in read_recordings(file, instrument):
                    raw = replace(read, name=unique_name(read.name, read.path, taken))
                    taken.add(raw.name)
                    then = _instrument_then(instrument, raw.start_unix_s)
                    source = resolve(raw, keys_for(name), then, name)
                    for note in raw.notes:
                        log.info(note)
                    for line in (*raw.warnings, *source.warnings, *image_doubts(source, then)):
                        log.warning(line)
                    own += _unless_a_copy(source, own, log)
        sources += own
    return sources, failures


@contextmanager
def failing_alone(
    failures: list[tuple[str, str]], input_name: str, file: Path, log: logging.Logger
) -> Iterator[None]:
    """Note in `failures` what goes wrong with a `file` of an input, so that the others go on."""
    try:
        yield
    except InputDataError as error:
        failures.append((input_name, str(error)))
    except MemoryError:
        raise
    except Exception as error:  # nobody foresees all that can stand in a file
        log.debug("%s", file, exc_info=True)
        problem = next(iter(str(error).splitlines()), "")
        failures.append((input_name, f"{file}: cannot be used: {type(error).__name__}: {problem}"))


def _unless_a_copy(source: Resolved, earlier: Sequence[Resolved], log: logging.Logger) -> list[Resolved]:
    """The recording, unless its frames are those of an earlier one of the input: they would count twice."""
    raw = source.raw
    alike = (one for one in earlier if one.raw.path != raw.path and one.raw.adu.shape == raw.adu.shape)
    alike = (one for one in alike if np.array_equal(one.raw.adu[0], raw.adu[0]))  # as nearly none are
    first = next((one for one in alike if np.array_equal(one.raw.adu, raw.adu)), None)
    if first is None:
        return [source]
    same_defocus = np.array_equal(first.introduced_defocus_nm, source.introduced_defocus_nm)
    if first.acquisition != source.acquisition or not same_defocus:
        raise InputDataError(
            f"{raw.path}: the same frames as in {first.raw.path}, but another side-car; remove one"
        )
    log.warning("%s: left out, a copy of %s", raw.path, first.raw.path)
    return []


def files_of(root: Path) -> list[Path]:
    """Return every file that ingest reads of an input, given as a file or folder `root`."""
    with suppress(NothingToDo):
        return [path for recording in recording_files([root]) for path in find.files_of(recording)]
    return []


def examined(
    inputs: Mapping[str, Sequence[Path]], config: Config, instrument: Instrument
) -> tuple[list[str], list[Recording]]:
    """Return a line for everything that keeps the recordings of `inputs` from being read or `accumulated`.

    With them go the recordings that are no darks as they are declared, their images dark. Raises
    `NothingToDo` for an input without recordings.
    """
    found: list[tuple[str, str]] = []
    recordings: list[Recording] = []
    for name, paths in inputs.items():
        for file in recording_files(paths):
            wrong = sidecar_problems(sidecar_path(file))
            found += [(name, line) for line in wrong]
            with failing_alone(found, name, file, logging.getLogger(__name__)):
                for raw in () if wrong else read_recordings(file, instrument):
                    then = _instrument_then(instrument, raw.start_unix_s)
                    source = resolve(raw, config.keys_for(name), then, name)
                    for line in (*raw.warnings, *image_doubts(source, then)):
                        logging.getLogger(__name__).warning(line)
                    if source.acquisition.role != "dark":
                        _sums(source, config.exposure_of(name))
                        recordings.append(as_declared(source))
    return list(dict.fromkeys(line for _, line in found)), recordings  # they may share a side-car


def as_declared(source: Resolved) -> Recording:
    """Return the recording of a `source` before its counts are looked at: all used and good, and dark."""
    raw, every = source.raw, np.ones(source.raw.frames, bool)
    return Recording(
        name=raw.name,
        input=source.input,
        images_e=np.broadcast_to(np.float32(0), raw.adu.shape),
        used=every,
        reason=np.full(raw.frames, ""),
        good=np.ones(raw.window, bool),
        time_s=np.zeros(raw.frames),
        frame_counter=raw.frame_counter,
        introduced_defocus_nm=source.introduced_defocus_nm,
        acquisition=source.acquisition,
        start_unix_s=raw.start_unix_s,
    )


def with_darks(sources: Sequence[Resolved], log: logging.Logger) -> tuple[list[Resolved], list[Resolved]]:
    """Give recordings without a dark the mean of a dark recording of the same input and window.

    Of the nearest exposure; another one is named in the `log`. Returns the stars and the darks.
    """
    darks = [source for source in sources if source.acquisition.role == "dark"]
    return [_with_dark(source, darks, log) for source in sources if source.acquisition.role != "dark"], darks


SAMPLED_PX = 2.0  # pixels per λ/D from which an image holds all detail that the optics make
CROWDED = 0.8  # part of the window beyond which a star that fills it is cut


def image_doubts(source: Resolved, instrument: Instrument) -> Iterator[str]:
    """Yield a sentence where, by what is declared, pixels or window are wrong for the image.

    A defocus of a nm RMS (Noll 4) spreads a star over a disc of twice its slope at the rim, 8√3 a/D.
    """
    raw, acquisition, diameter_m = source.raw, source.acquisition, instrument.pupil.diameter_m
    if acquisition.role == "dark" or acquisition.lenslets > 1:
        return
    scale_mas, window_px = acquisition.pixel_scale_mas, min(raw.window)
    shortest_nm = min(nm for nm, weight in acquisition.spectrum if weight > 0)
    pixels = resolution_px(shortest_nm * NM, diameter_m, scale_mas)
    if pixels < SAMPLED_PX:
        yield (
            f"{raw.name}: undersampled: λ/D at {shortest_nm:g} nm and D = {diameter_m:g} m is {pixels:.2g} "
            f"px of {scale_mas:g} mas; finer detail than {SAMPLED_PX:g} px is lost, which determines modes"
        )
    known_nm = acquisition.diversity.get(DEFOCUS, 0.0) + source.introduced_defocus_nm
    largest_nm = np.abs(known_nm).max()
    spread_px = 16 * np.sqrt(3) * largest_nm * NM / diameter_m * MAS_PER_RAD / scale_mas
    if spread_px > CROWDED * window_px:
        yield (
            f"{raw.name}: the declared defocus of {largest_nm:.0f} nm RMS spreads the star over "
            f"{spread_px:.0f} px of a window of {window_px}: light is cut off, or a unit is wrong"
        )


def _instrument_then(instrument: Instrument, unix_s: float) -> Instrument:
    """Return the instrument as it was when the recording was taken; as it is now if that is not known."""
    if not np.isfinite(unix_s):
        return instrument
    return instrument.on(datetime.fromtimestamp(unix_s, UTC).date().isoformat())


def _with_dark(source: Resolved, darks: Sequence[Resolved], log: logging.Logger) -> Resolved:
    fitting = [dark for dark in darks if dark.input == source.input and dark.raw.window == source.raw.window]
    if source.raw.calibration.dark_adu is not None or not fitting:
        return source
    nearest = min(fitting, key=lambda dark: _exposures_apart_s(dark, source))
    dark_s, own_s = (one.acquisition.exposure_s for one in (nearest, source))
    if _exposures_apart_s(nearest, source) > OTHER_EXPOSURE * (own_s or 0.0):
        log.warning(
            "%s: the dark %s is of %g s, the frames of %g s: its dark current is another",
            *(source.raw.name, nearest.raw.name, dark_s, own_s),
        )
    dark_adu, variance_adu2 = mean_frame(nearest.raw.adu), mean_variance(nearest.raw.adu)
    maps = replace(source.raw.calibration, dark_adu=dark_adu, dark_variance_adu2=variance_adu2)
    return replace(source, raw=replace(source.raw, calibration=maps))


def _exposures_apart_s(one: Resolved, other: Resolved) -> float:
    """Difference of the exposures [s]; 0 where either is not known."""
    first, second = (source.acquisition.exposure_s for source in (one, other))
    return 0.0 if first is None or second is None else abs(first - second)


# -- raw frames of a few milliseconds, summed to exposures of 0.1 to 2 s -----------------------------


def accumulated(source: Resolved, exposure_s: float | None) -> Resolved:
    """Return a recording with its frames summed to exposures of `exposure_s`; longer ones stay as they are.

    None leaves all as they are.

    Sums lie on a grid of frame counters that begins with the first frame: of frames that follow each other
    without a gap, at one introduced defocus. What fills no sum is left out. A pixel that is saturated in one
    of the frames is so in their sum.

    Raises `InputDataError` when the exposure of the frames is not known or does not divide `exposure_s`, or
    no sum is whole.
    """
    raw, members = source.raw, _sums(source, exposure_s)
    if members is None:
        return source
    count = members.shape[1]
    told = source.acquisition
    level = told.detector.saturation_adu
    level = float(np.iinfo(raw.adu.dtype).max) if level is None and _short(raw.adu) else level
    detector = replace(told.detector, saturation_adu=level).accumulated(count)
    rate_hz = None if told.frame_rate_hz is None else told.frame_rate_hz / count
    acquisition = replace(
        told, exposure_s=count * (told.exposure_s or 0.0), frame_rate_hz=rate_hz, detector=detector
    )
    first = members[:, 0]
    return replace(
        source,
        raw=_summed(raw, members, level),
        acquisition=acquisition,
        introduced_defocus_nm=source.introduced_defocus_nm[first],
    )


def _sums(source: Resolved, exposure_s: float | None) -> np.ndarray | None:
    """Indices of the frames of every sum, (sums, count), see `accumulated`; None where nothing is summed."""
    raw, own_s = source.raw, source.acquisition.exposure_s
    if exposure_s is None:
        return None
    if own_s is None:
        raise InputDataError(f"{raw.path}: exposure_s is not known; accumulate_s needs it")
    count = max(1, round(exposure_s / own_s))
    if own_s < exposure_s and not adds_up(exposure_s, own_s, count):
        raise InputDataError(
            f"{raw.path}: frames of {own_s:g} s do not add up to accumulate_s = {exposure_s:g} "
            f"({exposure_s / own_s:.4g} frames); give a multiple"
        )
    if count == 1:
        return None
    members = _members(raw.frame_counter, source.introduced_defocus_nm, count)
    if not len(members):
        raise InputDataError(
            f"{raw.path}: no {count} of its {raw.frames} frames follow each other without a gap, as "
            f"accumulate_s = {exposure_s:g} needs; lower it"
        )
    return members


def _members(counter: np.ndarray, introduced_nm: np.ndarray, count: int) -> np.ndarray:
    """Indices of the frames of every whole sum, (sums, count)."""
    place, off = np.divmod(counter - counter[0], counter_step(counter))
    order = np.flatnonzero((off == 0) & (place >= 0))
    order = order[np.argsort(place[order], kind="stable")]
    groups = np.split(order, np.flatnonzero(np.diff(place[order] // count)) + 1)
    whole = [
        group
        for group in groups
        if len(group) == count and np.all(np.diff(place[group]) == 1) and np.ptp(introduced_nm[group]) == 0
    ]
    return np.array(whole, dtype=int).reshape(-1, count)


def _short(adu: np.ndarray) -> bool:
    return adu.dtype.kind in "iu" and adu.dtype.itemsize <= SHORT_COUNTS


def _summed(raw: RawRecording, members: np.ndarray, level_adu: float | None) -> RawRecording:
    count, maps, first = members.shape[1], raw.calibration, members[:, 0]
    sums = np.stack([_sum_adu(raw.adu[group], level_adu) for group in members])
    darks = replace(
        maps,
        dark_adu=None if maps.dark_adu is None else count * maps.dark_adu,
        dark_variance_adu2=count**2 * maps.dark_variance_adu2,
        background_adu=None if maps.background_adu is None else count * maps.background_adu,
    )
    note = f"{raw.path}: {raw.frames} frames summed to {len(members)} of {count} each"
    return replace(
        raw,
        adu=sums,
        frame_counter=raw.frame_counter[first],
        calibration=darks,
        unix_s=None if raw.unix_s is None else raw.unix_s[first],
        notes=(*raw.notes, note),
    )


def _sum_adu(frames_adu: np.ndarray, level_adu: float | None) -> np.ndarray:
    """Sum of frames: int32 of counts that end at 16 bits, else float64."""
    total = frames_adu.sum(axis=0, dtype=np.int64 if _short(frames_adu) else np.float64)
    if level_adu is not None:
        total = np.where((frames_adu >= level_adu).any(axis=0), len(frames_adu) * level_adu, total)
    return total.astype(np.int32) if _short(frames_adu) else total
