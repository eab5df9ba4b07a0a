"""Plain FITS cube: images in the primary HDU or the first image extension."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.frames.raw import RawRecording
from irlos_pipe.readers.fitsfile import hdu_label, image_array, open_fits, stem

LAYOUT = "fits_cube"


def recognises(hdus: fits.HDUList) -> bool:
    """Tell whether a FITS file has an image that could be a cube."""
    return any(hdu.is_image and hdu.header.get("NAXIS", 0) > 0 for hdu in hdus)


def read(path: Path) -> RawRecording:
    """Read a cube (frames, y, x) or a single image (y, x).

    Raises
    ------
    InputDataError
        No image, or axes that cannot be a cube of images.
    """
    with open_fits(path) as hdus:
        index, hdu = next(
            ((i, h) for i, h in enumerate(hdus) if h.is_image and h.header.get("NAXIS", 0) > 0), (-1, None)
        )
        if hdu is None:
            raise InputDataError(f"{path}: no image in the file")
        adu = image_array(hdu, hdu_label(path, index, hdu))
    return RawRecording(stem(path), path, LAYOUT, adu, np.arange(len(adu)))
