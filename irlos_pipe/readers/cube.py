"""Plain FITS cube (frames, y, x) or image (y, x), in the primary HDU or the first image extension."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits

from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers.eso_header import plain_header_keys
from irlos_pipe.readers.fitsfile import first_image, has_image, hdu_label, image_array, require_one, stem
from irlos_pipe.readers.raw_file import RawRecording

LAYOUT = "fits_cube"


def recognises(hdus: fits.HDUList) -> bool:
    """Return whether a FITS file has an image that could be a cube."""
    return any(map(has_image, hdus))


def files_of(path: Path) -> list[Path]:
    """Return the files from which the recording in `path` is read: it alone."""
    return [path]


def read(path: Path, hdus: fits.HDUList, instrument: Instrument) -> list[RawRecording]:
    """See `irlos_pipe.readers.find.Reader.read`."""
    index, hdu = first_image(path, hdus)
    others = [other for other in hdus[index + 1 :] if has_image(other)]
    require_one(path, [hdu, *(other for other in others if _is_cube_too(other, hdu))], "cubes of frames")
    adu = image_array(hdu, hdu_label(path, index, hdu))
    header, notes = plain_header_keys(path, hdus[0].header, instrument)
    if others:
        unread = ", ".join(other.name or "without a name" for other in others)
        notes = (f"{path}: images that are not read: {unread}", *notes)
    return [
        RawRecording(
            name=stem(path),
            path=path,
            layout=LAYOUT,
            adu=adu,
            frame_counter=np.arange(len(adu)),
            header=header,
            notes=notes,
        )
    ]


def _is_cube_too(other: fits.hdu.base._BaseHDU, hdu: fits.hdu.base._BaseHDU) -> bool:
    """Whether an image may hold further frames; a name of its own says that it holds something else."""
    return other.header["NAXIS"] == 3 and other.name in ("", hdu.name)
