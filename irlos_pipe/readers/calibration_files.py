"""Calibration images beside a SPARTA recording: IRAcq.DET1.DARK.fits and its siblings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.frames.measured_noise import mean_variance
from irlos_pipe.frames.raw import CalibrationMaps
from irlos_pipe.readers.fitsfile import first_image, has_fits_name, hdu_label, native, open_fits, stem

PREFIX = "IRAcq.DET1."
KINDS = ("DARK", "BACKGROUND", "FLAT", "DEAD", "WEIGHT")
MAX_BAD_FRACTION = 0.5  # a map that excludes more than this means something else


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
    """Read the calibration images of a recording.

    Parameters
    ----------
    found : mapping of str to Path
        Files by kind, see `calibration_files`.
    window : tuple of int
        Rows and columns of the recording [px].

    Returns
    -------
    maps : CalibrationMaps
    notes : tuple of str
        Remarks for the log.

    Raises
    ------
    InputDataError
        An image that cannot be read or does not fit the window.
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
