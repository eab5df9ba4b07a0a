"""SPARTA recorder folder: a table IRPixelFrame with one frame per row, calibration images next to it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from astropy.io import fits

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.frames.recording import CalibrationMaps
from irlos_pipe.frames.told import mean_variance
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers.acquisition import RawRecording, plain_header_keys
from irlos_pipe.readers.fitsfile import (
    file_header,
    first_image,
    has_fits_name,
    hdu_label,
    native,
    open_fits,
    require_cube,
    require_one,
    stem,
)
from irlos_pipe.readers.times import column, require_times, unix_seconds

LAYOUT = "sparta_recorder"
PIXEL_TABLE = "IRPIXELFRAME"
LOOP_TABLE = "IRLOOPFRAME"
PIXELS = "Pixels"
NOT_READ = (".z", ".zip")  # what nobody can unpack here is no reason to refuse the recording next to it
# Calibration images next to the table: IRAcq.DET1.DARK.fits and its siblings.
PREFIX, KINDS = "IRAcq.DET1.", ("DARK", "BACKGROUND", "FLAT", "DEAD", "WEIGHT")
MAX_BAD_FRACTION = 0.5  # a map that excludes a larger part of the pixels has another meaning
PIXEL_FOLDER_SUFFIX = "_PIX"  # GALACSI keeps NAME_IR (loop, calibration) next to NAME_IR_PIX (pixels)


def recognises(hdus: fits.HDUList) -> bool:
    """Return whether a FITS file holds a SPARTA pixel table."""
    return _table(hdus, PIXEL_TABLE)[1] is not None


def is_telemetry(hdus: fits.HDUList) -> bool:
    """Return whether a FITS file holds a table of the loop, which belongs to a recording next to it."""
    return _table(hdus, LOOP_TABLE)[1] is not None


def files_of(path: Path) -> list[Path]:
    """Return the files from which the recording in `path` is read: table, calibration images, loop tables.

    Loop tables are those that are searched for the times of the frames, none if the file itself has them.
    """
    folders = _folders(path)
    files = [path, *calibration_files(folders).values()]
    candidates = _loop_candidates(path, folders)
    if candidates:
        with open_fits(path, verify=False) as hdus:
            own = _table_times(path, hdus, PIXEL_TABLE) or _table_times(path, hdus, LOOP_TABLE)
        files += [] if own else _searched(candidates)[0]
    return files


def read(path: Path, hdus: fits.HDUList, instrument: Instrument) -> list[RawRecording]:
    """Read the recording, see `irlos_pipe.readers.find.Reader.read`.

    Raises `InputDataError` for a column that is missing, a window that changes or does not fit the pixel
    vector, no rows, or calibration images that do not fit.
    """
    index, table = _table(hdus, PIXEL_TABLE)
    assert table is not None, f"{path}: not a recorder file"
    require_one(path, [one for one in hdus if one.name.upper() == PIXEL_TABLE], "tables IRPixelFrame")
    adu, counter = _frames(table, hdu_label(path, index, table))
    folders = _folders(path)
    maps, notes = read_calibration_maps(calibration_files(folders), (adu.shape[1], adu.shape[2]))
    times, time_notes = _times(path, hdus, folders, counter)
    header, header_notes = plain_header_keys(path, file_header(hdus), instrument)
    return [
        RawRecording(
            name=stem(path),
            path=path,
            layout=LAYOUT,
            adu=adu,
            frame_counter=counter,
            calibration=maps,
            unix_s=times,
            start_unix_s=float("nan") if times is None else float(times[np.isfinite(times)][0]),
            header=header,
            notes=notes + time_notes + header_notes,
        )
    ]


def _frames(table: fits.BinTableHDU, where: str) -> tuple[np.ndarray, np.ndarray]:
    counter, width, height, pixels = (
        _required(table, name, where) for name in ("FrameCounter", "WindowSizeX", "WindowSizeY", PIXELS)
    )
    if len(pixels) == 0:
        raise InputDataError(f"{where}: no frames (0 rows)")
    if pixels.dtype == object:
        raise InputDataError(
            f"{where}: column 'Pixels' has vectors of varying length, expected a fixed length"
        )
    changed = np.flatnonzero((width != width[0]) | (height != height[0]))
    if changed.size:
        row = changed[0]
        raise InputDataError(
            f"{where}: the window changes from {width[0]}x{height[0]} to {width[row]}x{height[row]} "
            f"(x, y) px in row {row + 1}; split the recording there"
        )
    if width[0] <= 0 or height[0] <= 0:
        raise InputDataError(f"{where}: a window of {width[0]}x{height[0]} (x, y) px")
    columns, rows = int(width[0]), int(height[0])
    vectors = pixels.reshape(len(pixels), -1)
    if columns * rows > vectors.shape[1]:
        raise InputDataError(
            f"{where}: a window of {columns}x{rows} (x, y) px needs {columns * rows} values, "
            f"column 'Pixels' holds {vectors.shape[1]} per row"
        )
    # vectors are padded; the first columns * rows values count, x fastest
    cube = native(vectors[:, : columns * rows]).reshape(-1, rows, columns)
    return require_cube(cube, where), native(counter).astype(np.int64)


def _required(table: fits.BinTableHDU, name: str, where: str) -> np.ndarray:
    values = column(table, name)
    if values is None:
        raise InputDataError(f"{where}: no column '{name}'; found {', '.join(table.columns.names)}")
    if name != PIXELS and values.ndim != 1:
        raise InputDataError(f"{where}: column '{name}' has {values[0].size} values per row, expected one")
    return values


def _table(hdus: fits.HDUList, name: str) -> tuple[int, fits.BinTableHDU | None]:
    return next(
        (
            (index, hdu)
            for index, hdu in enumerate(hdus)
            if hdu.name.upper() == name and isinstance(hdu, fits.BinTableHDU)
        ),
        (-1, None),
    )


def _folders(path: Path) -> list[Path]:
    """Folders that belong to a recording: its own, and the loop's next to a ``_PIX`` one."""
    folder = path.parent
    loop = folder.with_name(folder.name.removesuffix(PIXEL_FOLDER_SUFFIX))
    return [folder, loop] if loop != folder and loop.is_dir() else [folder]


class _TableTimes(NamedTuple):
    """Times of the rows of a table [s since 1970], and their frame counters."""

    counter: np.ndarray
    unix_s: np.ndarray


def _table_times(path: Path, hdus: fits.HDUList, name: str) -> _TableTimes | None:
    """Return the times in the table of this name; None if there is none, or it has no times."""
    index, table = _table(hdus, name)
    times = None if table is None else unix_seconds(table)
    if table is None or times is None:
        return None
    where = hdu_label(path, index, table)
    require_times(times, where)
    return _TableTimes(_required(table, "FrameCounter", where), times)


def _times(
    path: Path, hdus: fits.HDUList, folders: list[Path], counter: np.ndarray
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Times of the frames, from the pixel table or else from a loop table by counter; remarks for the log."""
    own = _table_times(path, hdus, PIXEL_TABLE)
    if own is not None:
        return own.unix_s, ()
    source, loop = path, _table_times(path, hdus, LOOP_TABLE)
    if loop is None:
        searched, loop = _searched(_loop_candidates(path, folders))
        source = searched[-1] if searched else path
    if loop is None:
        return None, (f"{path}: no times recorded; taken from the frame counter and the frame rate",)
    by_counter = dict(zip(loop.counter.tolist(), loop.unix_s.tolist(), strict=True))
    paired = np.array([by_counter.get(number, np.nan) for number in counter.tolist()], dtype=np.float64)
    missing = int(np.isnan(paired).sum())
    note = f"{path}: times from {source.name}, {missing} of {len(counter)} frames not found in it"
    return (None if missing == len(counter) else paired), (note,)


def _loop_candidates(path: Path, folders: list[Path]) -> list[Path]:
    """Return the other FITS files of the folders, which may hold the loop table."""
    others = (other for folder in folders for other in sorted(folder.iterdir()))
    return [
        other
        for other in others
        if other != path
        and has_fits_name(other)
        and other.suffix.lower() not in NOT_READ
        and not other.name.startswith((PREFIX, "."))
        and other.is_file()
    ]


def _searched(candidates: list[Path]) -> tuple[list[Path], _TableTimes | None]:
    """Return the files up to the first with the times of the loop, and these times."""
    for number, candidate in enumerate(candidates, start=1):
        with open_fits(candidate) as hdus:
            times = _table_times(candidate, hdus, LOOP_TABLE)
        if times is not None:
            return candidates[:number], times
    return candidates, None


def calibration_files(folders: Sequence[Path]) -> dict[str, Path]:
    """Return the calibration images by kind; the first of the `folders` that has an image wins."""
    found: dict[str, Path] = {}
    for folder in folders:
        for path in sorted(folder.glob(f"{PREFIX}*")):  # X.fits before X.fits.gz
            if has_fits_name(path) and path.is_file():
                found.setdefault(stem(path).removeprefix(PREFIX), path)
    return {kind: found[kind] for kind in KINDS if kind in found}


def read_calibration_maps(
    found: Mapping[str, Path], window: tuple[int, int]
) -> tuple[CalibrationMaps, tuple[str, ...]]:
    """Read the calibration images `found`, of a `window` (rows, columns); also remarks for the log.

    Raises `InputDataError` for an image that cannot be read or does not fit the window.
    """
    images = {kind: _read_stack(path, window) for kind, path in found.items()}
    means = {kind: stack.mean(axis=0) for kind, stack in images.items()}
    maps = CalibrationMaps(
        dark_adu=means.get("DARK"),
        background_adu=means.get("BACKGROUND"),
        flat=means.get("FLAT"),
        bad=_dead(means.get("DEAD"), found.get("DEAD")),
    )
    if "DARK" in images:
        maps = replace(maps, dark_variance_adu2=mean_variance(images["DARK"]))
    return _with_weight(maps, means.get("WEIGHT"), found.get("WEIGHT"))


def _read_stack(path: Path, window: tuple[int, int]) -> np.ndarray:
    """Read an image or a stack of images as float32 (images, rows, columns)."""
    with open_fits(path) as hdus:
        index, hdu = first_image(path, hdus)
        data = native(hdu.data).astype(np.float32)
        where = hdu_label(path, index, hdu)
    # SPARTA also stores maps as one long vector, x fastest
    data = data.reshape(1, *window) if data.size == window[0] * window[1] else data
    if data.ndim != 3 or data.shape[1:] != window:
        raise InputDataError(
            f"{where}: {'x'.join(map(str, data.shape))} (y, x) px do not fit the window of "
            f"{window[0]}x{window[1]} px"
        )
    return data


def _dead(dead: np.ndarray | None, path: Path | None) -> np.ndarray | None:
    if dead is None:
        return None
    bad = ~(dead == 0)
    if bad.mean() > MAX_BAD_FRACTION:
        raise InputDataError(f"{path}: marks {bad.sum()} of {bad.size} pixels as dead; 0 means good, 1 dead")
    return bad


def _with_weight(
    maps: CalibrationMaps, weight: np.ndarray | None, path: Path | None
) -> tuple[CalibrationMaps, tuple[str, ...]]:
    if weight is None:
        return maps, ()
    bad = ~(weight > 0)
    if bad.mean() > MAX_BAD_FRACTION:
        return maps, (
            f"{path}: no weight on {bad.sum()} of {bad.size} pixels: taken for a centroiding window, "
            "not for bad pixels",
        )
    return replace(maps, bad=bad if maps.bad is None else maps.bad | bad), ()
