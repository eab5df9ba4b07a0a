"""Files that announce more than they hold, or hold more than they say. Truth: astropy, which wrote them."""

import bz2
import gzip
import lzma

import numpy as np
import pytest
from astropy.io import fits

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.readers.fitsfile import open_fits

CUBE = np.arange(4000, dtype=np.int32).reshape(10, 20, 20) // 50
CARD = 80


def with_card(content: bytes, key: str, value: int) -> bytes:
    """A file with another value of a key."""
    place = content.index(f"{key:<8}= ".encode())
    return content[:place] + f"{key:<8}= {value:>20}".ljust(CARD).encode() + content[place + CARD :]


@pytest.fixture
def path(tmp_path):
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(CUBE)]).writeto(tmp_path / "a.fits", checksum=True)
    return tmp_path / "a.fits"


def refusal(path) -> str:
    with pytest.raises(InputDataError) as caught, open_fits(path) as hdus:
        assert hdus[1].data is not None
    return str(caught.value)


@pytest.mark.parametrize("how", ["RICE_1", "GZIP_1", "HCOMPRESS_1", "PLIO_1"])
def test_tile_compressed_images_are_read_whatever_they_shrank_to(tmp_path, how):
    image = fits.CompImageHDU(CUBE, compression_type=how, tile_shape=(1, 20, 20))
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(tmp_path / "a.fits")
    with open_fits(tmp_path / "a.fits") as hdus:
        assert np.array_equal(hdus[1].data, CUBE)


def test_data_that_do_not_fit_their_checksum_are_refused(path):
    content = bytearray(path.read_bytes())
    content[-2880] ^= 1
    path.write_bytes(content)
    assert "HDU 1: the data do not fit their DATASUM" in refusal(path)


def test_something_behind_the_last_hdu_that_is_no_extension_is_refused_but_padding_is_not(path):
    whole = path.read_bytes()
    path.write_bytes(whole + bytes(2880))
    with open_fits(path) as hdus:
        assert len(hdus) == 2
    path.write_bytes(whole + b"x" * 100)
    assert "something follows HDU 1 that is no extension" in refusal(path)


@pytest.mark.parametrize("name", ["a.fits", "a.fits.gz"])
@pytest.mark.parametrize("key", ["NAXIS", "TFIELDS"])
def test_headers_with_billions_of_axes_or_columns_are_refused_at_once(tmp_path, name, key):
    columns = [fits.Column("x", "J", array=np.arange(3))]
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns)]).writeto(tmp_path / "whole.fits")
    content = with_card((tmp_path / "whole.fits").read_bytes(), key, 2**31)
    (tmp_path / name).write_bytes(gzip.compress(content) if name.endswith("gz") else content)
    assert f"{key} = 2147483648 in a header, FITS allows 999" in refusal(tmp_path / name)


def test_a_small_compressed_file_whose_header_announces_more_than_it_holds_is_refused(tmp_path):
    fits.writeto(tmp_path / "whole.fits", CUBE)
    content = with_card((tmp_path / "whole.fits").read_bytes(), "NAXIS3", 10**9)
    (tmp_path / "a.fits.gz").write_bytes(gzip.compress(content))
    assert "truncated, or a wrong header" in refusal(tmp_path / "a.fits.gz")


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress])
def test_few_bytes_that_unpack_to_many_are_refused_while_they_are_unpacked(tmp_path, monkeypatch, pack):
    monkeypatch.setattr("irlos_pipe.files.regular.MAX_UNPACKED_BYTES", 2**21)
    fits.writeto(tmp_path / "whole.fits", np.zeros((200, 64, 64)))
    (tmp_path / "a.fits").write_bytes(pack((tmp_path / "whole.fits").read_bytes()))
    assert "that unpack to more than 2097152" in refusal(tmp_path / "a.fits")
