"""The first image of a FITS file."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits

from irlos_pipe.files.regular import first_image


def test_image_behind_a_table_is_found(tmp_path):
    """What astropy wrote comes back with its header, behind an empty primary and a table."""
    table = fits.BinTableHDU.from_columns([fits.Column("a", "E", array=np.zeros(3))])
    drawn = fits.ImageHDU(np.arange(12, dtype=">i2").reshape(3, 4))
    drawn.header["PUPLSCAL"] = 0.125
    fits.HDUList([fits.PrimaryHDU(), table, drawn]).writeto(tmp_path / "map.fits")

    image, header = first_image(tmp_path / "map.fits")

    assert image.dtype == np.float64
    np.testing.assert_array_equal(image, drawn.data)
    assert header["PUPLSCAL"] == 0.125


@pytest.mark.parametrize("content", [None, b"", b"SIMPLE", b"no FITS at all" * 400])
def test_what_is_no_fits_file_says_so(tmp_path, content):
    if content is not None:
        (tmp_path / "map.fits").write_bytes(content)
    with pytest.raises(ValueError, match="cannot be read: "):
        first_image(tmp_path / "map.fits")


def test_file_without_image_says_so(tmp_path):
    fits.PrimaryHDU().writeto(tmp_path / "map.fits")
    with pytest.raises(ValueError, match="holds no image"):
        first_image(tmp_path / "map.fits")
