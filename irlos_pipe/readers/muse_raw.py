"""Raw file of MUSE's narrow-field mode: image extension SPARTA_TT_CUBE, side tables, header."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.conventions.laws import SPARTA
from irlos_pipe.conventions.text import suggestion
from irlos_pipe.instrument.instrument import Instrument, Mode
from irlos_pipe.readers.acquisition import RawRecording, header_keys
from irlos_pipe.readers.fitsfile import hdu_label, image_array, require_one, stem
from irlos_pipe.readers.sidecar import AcquisitionKeys, read_sidecar, sidecar_path
from irlos_pipe.readers.times import iso_time, require_times, start_of, unix_seconds

LAYOUT = "muse_raw"
CUBE = "SPARTA_TT_CUBE"
ATMOSPHERE = "SPARTA_ATM_DATA"
MODE_KEY = "ESO AOS MAIN MODES IRLOS"
SEEING_RANGE_ARCSEC = (0.05, 10.0)


def recognises(hdus: fits.HDUList) -> bool:
    """Return whether a FITS file holds a cube of the low-order sensor."""
    return any(hdu.name.upper() == CUBE for hdu in hdus)


def read(path: Path, hdus: fits.HDUList, instrument: Instrument) -> list[RawRecording]:
    """See `irlos_pipe.readers.find.Reader.read`: in 2x2 modes the four images side by side, without borders.

    Raises `InputDataError` for an unknown or missing mode string, or a cube that does not fit the mode.
    """
    require_one(path, [hdu for hdu in hdus if hdu.name.upper() == CUBE], f"images {CUBE}")
    index = next(i for i, hdu in enumerate(hdus) if hdu.name.upper() == CUBE)
    where = hdu_label(path, index, hdus[index])
    adu = image_array(hdus[index], where)
    header = hdus[0].header
    mode = _mode(header, instrument, path)
    target = {"target": str(header["OBJECT"])} if header.get("OBJECT") else {}
    implied = {} if mode.lenslets == 1 else instrument.profile.lenslets  # 2x2: no lens for a diversity
    whole = RawRecording(
        name=stem(path),
        path=path,
        layout=LAYOUT,
        adu=adu,
        frame_counter=np.arange(len(adu)),
        header=header_keys(header) | target | _from_atmosphere(hdus),
        mode=mode.name,
        of_mode=AcquisitionKeys.model_validate(implied).flat()
        | {
            "pixel_scale_mas": mode.pixel_scale_mas,
            "frame_rate_hz": mode.frame_rate_hz,
            "exposure_s": 1 / mode.frame_rate_hz,
            "detector.e_per_adu": mode.e_per_adu,
        },
        start_unix_s=_start(hdus, header, path),
    )
    if mode.lenslets == 1:
        return [whole]
    return [replace(whole, adu=without_borders(adu, where), lenslets=mode.lenslets)]


def _mode(header: fits.Header, instrument: Instrument, path: Path) -> Mode:
    sidecar = read_sidecar(sidecar_path(path))
    name = str(header.get(MODE_KEY, "")).strip() or sidecar.mode or ""
    if not name:
        raise InputDataError(
            f"{path}: HDU 0: header key {MODE_KEY} is missing or cannot be read, so the read-out "
            "mode is not known; add mode to the side-car"
        )
    day = iso_time(start_of(header))[:10]
    modes = (instrument.on(day) if day else instrument).modes
    if name not in modes:
        raise InputDataError(
            f"{path}: HDU 0: {MODE_KEY} = '{name}' is no mode of {instrument.name}"
            f"{suggestion(name, modes)} (a new mode goes into the instrument profile)"
        )
    changed = {"pixel_scale_mas", "detector.e_per_adu"}  # of the 2x2 modes, from one day on
    if modes[name].lenslets > 1 and not day and not changed <= sidecar.flat().keys():
        raise InputDataError(
            f"{path}: HDU 0: DATE-OBS is missing or cannot be read, and with it the pixel scale and the gain "
            f"of {name}, which have changed; add pixel_scale_mas and detector.e_per_adu to the side-car"
        )
    return modes[name]


def _from_atmosphere(hdus: fits.HDUList) -> dict[str, Any]:
    """Median seeing of SPARTA's own estimate, which is the scale the AO residual's law is stated on."""
    if ATMOSPHERE not in hdus or hdus[ATMOSPHERE].data is None:
        return {}
    table = hdus[ATMOSPHERE]
    columns = [name for name in table.columns.names if name.upper().endswith("SEEING")]
    values = np.concatenate([np.ravel(table.data[name]).astype(float) for name in columns] or [np.empty(0)])
    low, high = SEEING_RANGE_ARCSEC
    values = values[(values > low) & (values < high)]
    return {"seeing_arcsec": float(np.median(values)), "seeing_scale": SPARTA} if values.size else {}


def _start(hdus: fits.HDUList, header: fits.Header, path: Path) -> float:
    """Begin of the exposure [s since 1970]: of the header, else the first row of the atmosphere table."""
    stated = start_of(header)
    if np.isfinite(stated):
        return stated
    times = unix_seconds(hdus[ATMOSPHERE]) if ATMOSPHERE in hdus else None
    if times is None or not times.size:
        return float("nan")
    require_times(times, f"{path}: {ATMOSPHERE}")
    return float(times[0])


def without_borders(cube: np.ndarray, where: str) -> np.ndarray:
    """Return the images of the four lenslets side by side, without the border of zeros around each.

    The `cube` (frames, rows, columns) has a border one pixel wide in each quadrant; returns (frames, rows -
    4, columns - 4). `where` begins the message of an error.

    Raises `InputDataError` for a window that cannot be halved, or a border that is not zero.
    """
    rows, columns = cube.shape[1:]
    if rows % 2 or columns % 2:
        raise InputDataError(
            f"{where}: a window of {rows}x{columns} px has no four equal quadrants, "
            "which the 2x2 mode of the header asks for"
        )
    apart = cube.reshape(len(cube), 2, rows // 2, 2, columns // 2)
    border = np.ones((rows // 2, columns // 2), dtype=bool)
    border[1:-1, 1:-1] = False
    for number, (y, x) in enumerate(np.ndindex(2, 2), start=1):
        if np.any(apart[:, y, :, x][:, border] != 0):
            raise InputDataError(
                f"{where}: quadrant {number} lacks the one-pixel border of zeros of a 2x2 mode"
            )
    return np.ascontiguousarray(apart[:, :, 1:-1, :, 1:-1]).reshape(len(cube), rows - 4, columns - 4)
