"""SPARTA recorder folder: a table IRPixelFrame with one frame per row, calibration images beside it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from astropy.io import fits

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.frames.raw import RawRecording
from irlos_pipe.readers.calibration_files import PREFIX, read_calibration_maps
from irlos_pipe.readers.fitsfile import has_fits_name, hdu_label, native, open_fits, require_cube, stem
from irlos_pipe.readers.times import column, pair_by_counter, unix_seconds

LAYOUT = "sparta_recorder"
PIXEL_TABLE = "IRPIXELFRAME"
LOOP_TABLE = "IRLOOPFRAME"
PIXEL_FOLDER_SUFFIX = "_PIX"  # GALACSI keeps NAME_IR (loop, calibration) beside NAME_IR_PIX (pixels)


def recognises(hdus: fits.HDUList) -> bool:
    """Tell whether a FITS file holds a SPARTA pixel table."""
    return any(hdu.name.upper() == PIXEL_TABLE for hdu in hdus)


def read(path: Path) -> RawRecording:
    """Read the recording whose pixel table is in `path`.

    Raises
    ------
    InputDataError
        A column that is missing, a window that changes or does not fit the pixel vector, no rows,
        or calibration images that do not fit.
    """
    with open_fits(path) as hdus:
        index, table = _table(hdus, PIXEL_TABLE)
        where = hdu_label(path, index, table)
        adu, counter = _frames(table, where)
        own_times = unix_seconds(table)
    folders = _folders(path)
    maps, notes = read_calibration_maps(folders, adu.shape[1:])
    times, time_note = (own_times, ()) if own_times is not None else _times_from_loop(path, folders, counter)
    start = float(times[0]) if times is not None else float("nan")
    return RawRecording(
        stem(path),
        path,
        LAYOUT,
        adu,
        counter,
        times,
        calibration=maps,
        start_unix_s=start,
        notes=notes + time_note,
    )


def _frames(table: fits.BinTableHDU, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Return images (frames, rows, columns) and frame counters."""
    counter, width, height, pixels = (
        _required(table, name, where) for name in ("FrameCounter", "WindowSizeX", "WindowSizeY", "Pixels")
    )
    if len(pixels) == 0:
        raise InputDataError(f"{where}: no frames (0 rows)")
    if pixels.dtype == object:
        raise InputDataError(
            f"{where}: column 'Pixels' has vectors of varying length, expected a fixed length"
        )
    columns, rows = _window(width, height, where)
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
    return values


def _window(width: np.ndarray, height: np.ndarray, where: str) -> tuple[int, int]:
    """Return columns and rows of the window, which must be the same in every frame."""
    changed = np.flatnonzero((width != width[0]) | (height != height[0]))
    if changed.size:
        row = changed[0]
        raise InputDataError(
            f"{where}: the window changes from {width[0]}x{height[0]} to {width[row]}x{height[row]} "
            f"(x, y) px in row {row + 1}; split the recording there"
        )
    if width[0] <= 0 or height[0] <= 0:
        raise InputDataError(f"{where}: a window of {width[0]}x{height[0]} (x, y) px")
    return int(width[0]), int(height[0])


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
    """Folders that belong to a recording: its own, and the loop's beside a ``_PIX`` one."""
    folder = path.parent
    loop = folder.with_name(folder.name.removesuffix(PIXEL_FOLDER_SUFFIX))
    return [folder, loop] if loop != folder and loop.is_dir() else [folder]


def _times_from_loop(
    path: Path, folders: list[Path], counter: np.ndarray
) -> tuple[np.ndarray | None, tuple[str, ...]]:
    """Times of the frames from the loop table, by counter; and a remark for the log."""
    for candidate in _loop_candidates(path, folders):
        with open_fits(candidate) as hdus:
            _, table = _table(hdus, LOOP_TABLE)
            times = unix_seconds(table) if table is not None else None
            if times is not None:
                paired = pair_by_counter(counter, column(table, "FrameCounter"), times)
                missing = int(np.isnan(paired).sum())
                note = (
                    f"{path}: times from {candidate.name}, {missing} of {len(counter)} frames not found in it"
                )
                return (None if missing == len(counter) else paired), (note,)
    return None, (f"{path}: no times recorded; taken from the frame counter and the frame rate",)


def _loop_candidates(path: Path, folders: list[Path]) -> Iterator[Path]:
    yield path
    for folder in folders:
        for candidate in sorted(folder.iterdir()):
            if candidate != path and has_fits_name(candidate) and not candidate.name.startswith(PREFIX):
                yield candidate
