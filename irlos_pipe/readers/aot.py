"""Adaptive Optics Telemetry (AOT) files, read through the optional package aotpy."""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.late import LateModule
from irlos_pipe.conventions.units import MAS
from irlos_pipe.frames.recording import CalibrationMaps
from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers.acquisition import RawRecording
from irlos_pipe.readers.fitsfile import native, require_cube, stem

LAYOUT = "aot"
VERSION_KEY = "AOT-VERS"


def recognises(hdus: fits.HDUList) -> bool:
    """Return whether a FITS file says that it follows the AOT standard."""
    return VERSION_KEY in hdus[0].header


def read(path: Path, hdus: fits.HDUList, instrument: Instrument) -> list[RawRecording]:
    """See `irlos_pipe.readers.find.Reader.read`: one recording per detector that looks at a star.

    Raises `InputDataError` where aotpy is not installed, the file breaks the standard, or no detector
    recorded its pixels.
    """
    system = _system(path)
    detectors = [
        detector
        for detector in _star_detectors(system)
        if detector.pixel_intensities is not None and np.ndim(detector.pixel_intensities.data) == 3
    ]
    if not detectors:
        raise InputDataError(f"{path}: an AOT file, but no detector that looks at a star recorded its pixels")
    names = (
        [stem(path)] if len(detectors) == 1 else [f"{stem(path)}-{detector.uid}" for detector in detectors]
    )
    return [_recording(detector, name, path) for name, detector in zip(names, detectors, strict=True)]


def _system(path: Path) -> Any:
    needed = f"{path}: AOT files need the package aotpy; install it with: pip install aotpy"
    system = LateModule("aotpy", InputDataError(needed)).AOSystem
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # aotpy warns of every table that is empty
            return system.read_from_file(path)
    except Exception as error:  # aotpy has no error class of its own
        raise InputDataError(f"{path}: not a readable AOT file: {' '.join(str(error).split())}") from None


def _star_detectors(system: Any) -> Iterator[Any]:
    from aotpy import RayleighLaserGuideStar, SodiumLaserGuideStar

    for sensor in (*system.scoring_cameras, *system.wavefront_sensors):
        source = getattr(sensor, "source", None)
        if (
            not isinstance(source, (SodiumLaserGuideStar, RayleighLaserGuideStar))
            and sensor.detector is not None
        ):
            yield sensor.detector


def _recording(detector: Any, name: str, path: Path) -> RawRecording:
    pixels = detector.pixel_intensities
    where = f"{path}: detector '{detector.uid}'"
    adu = require_cube(native(np.asarray(pixels.data)), where)
    times = _per_frame(pixels.time, "timestamps", len(adu))
    counter = _per_frame(pixels.time, "frame_numbers", len(adu))
    scale = None if detector.pixel_scale is None else detector.pixel_scale / MAS
    numbers = {
        "pixel_scale_mas": scale,
        "exposure_s": detector.integration_time,
        "frame_rate_hz": detector.frame_rate,
        "detector.excess_noise_factor": detector.excess_noise,
    }
    return RawRecording(
        name=name,
        path=path,
        layout=LAYOUT,
        adu=adu,
        frame_counter=np.arange(len(adu)) if counter is None else counter.astype(np.int64),
        unix_s=times,
        header={
            key: float(value) for key, value in numbers.items() if value is not None and np.isfinite(value)
        },
        calibration=_maps(detector, adu.shape[1:], where),
        start_unix_s=float("nan") if times is None else float(times[0]),
    )


def _per_frame(time: Any, attribute: str, frames: int) -> np.ndarray | None:
    values = np.asarray(getattr(time, attribute, None) or [], dtype=np.float64)
    return values if len(values) == frames and np.all(np.isfinite(values)) else None


def _maps(detector: Any, window: tuple[int, int], where: str) -> CalibrationMaps:
    dark, background, correction, bad = (
        _map(getattr(detector, name), window, f"{where}, {name}")
        for name in ("dark", "sky_background", "flat_field", "bad_pixel_map")
    )
    # the standard's flat field is the inverse of the sensitivity
    flat = (
        None
        if correction is None
        else np.divide(1, correction, out=np.zeros(window, np.float32), where=correction > 0)
    )
    return CalibrationMaps(
        dark_adu=dark, background_adu=background, flat=flat, bad=None if bad is None else bad != 0
    )


def _map(image: Any, window: tuple[int, int], where: str) -> np.ndarray | None:
    if image is None:
        return None
    if np.shape(image.data) != window:
        raise InputDataError(f"{where}: shape {np.shape(image.data)} does not fit the window {window}")
    return native(np.asarray(image.data)).astype(np.float32)
