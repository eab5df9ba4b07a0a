"""Astropy's FITS, imported by its first use, see `conventions.late`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from irlos_pipe.conventions.late import LateModule

if TYPE_CHECKING:
    from astropy.io import fits as fits
else:
    fits = LateModule("astropy.io.fits")
