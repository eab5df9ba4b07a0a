"""Astropy's FITS, imported by its first use, and what people draw themselves in such files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from irlos_pipe.conventions.late import LateModule
from irlos_pipe.files.regular import open_regular

if TYPE_CHECKING:
    from astropy.io import fits as fits
else:
    fits = LateModule("astropy.io.fits")


def first_image(path: Path) -> tuple[np.ndarray, Mapping[str, Any]]:
    """Return the first image of the FITS file at `path` that has data, in float64, and its header.

    Raises `ValueError` where the file cannot be read, or holds no image; names the reason and not the file.
    """
    try:
        with open_regular(path) as stream, fits.open(stream, memmap=False) as hdus:
            image = next((hdu for hdu in hdus if hdu.is_image and hdu.data is not None), None)
            if image is not None:
                return np.asarray(image.data, dtype=np.float64), image.header
    except (OSError, TypeError, ValueError) as error:
        raise ValueError(f"cannot be read: {str(error).splitlines()[0]}") from None
    raise ValueError("holds no image")
