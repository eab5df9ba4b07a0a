"""Plain FITS cube (frames, y, x) or image (y, x), in the primary HDU or the first image extension."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits

from irlos_pipe.instrument.instrument import Instrument
from irlos_pipe.readers.fitsfile import first_image, has_image, hdu_label, image_array, stem
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
    adu = image_array(hdu, hdu_label(path, index, hdu))
    counter = np.arange(len(adu))
    return [RawRecording(name=stem(path), path=path, layout=LAYOUT, adu=adu, frame_counter=counter)]
