"""Files as packers, archives and browsers leave them are read or named. Truth: what was packed."""

import bz2
import gzip
import io
import lzma
import shutil
import subprocess
import zipfile
from pathlib import Path

import astropy
import numpy as np
import pytest
from astropy.io import fits
from helpers.sparta_files import counts, star, write_muse, write_sidecar

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.find import read_recordings, recording_files
from irlos_pipe.readers.fitsfile import open_fits, stored_hdus
from irlos_pipe.readers.sidecar import sidecar_path

IRLOS = load_instrument("irlos")
CUBE = np.rint(counts(star(24, 20), 3)).astype(np.uint16)
BLOCK = 2880
TILED = Path(astropy.__file__).parent / "io" / "fits" / "hdu" / "compressed" / "tests" / "data"
FPACK = pytest.mark.skipif(shutil.which("fpack") is None, reason="fpack is not installed")


def one(path):
    (raw,) = read_recordings(path, IRLOS)
    return raw


def written(*hdus, checksum=True) -> bytes:
    stream = io.BytesIO()
    fits.HDUList(list(hdus)).writeto(stream, checksum=checksum)
    return stream.getvalue()


WHOLE = written(fits.PrimaryHDU(CUBE))


@pytest.mark.parametrize("name", ["m13_rice", "m13_gzip", "m13_hcomp", "m13_plio"])
def test_images_that_the_tools_themselves_packed_are_read(name):
    path = TILED / f"{name}.fits"
    if not path.is_file():
        pytest.skip("astropy comes without its test data")
    assert np.array_equal(one(path).adu[0], fits.getdata(path, 1))


@FPACK
def test_a_packed_raw_file_is_the_same_recording_and_damage_of_its_tiles_is_seen(tmp_path):
    path = write_muse(tmp_path / "m.fits", CUBE, seeing=[0.6, 0.7])
    with fits.open(path) as hdus:
        hdus.writeto(tmp_path / "n.fits", checksum=True)
    shutil.move(tmp_path / "n.fits", path)
    write_sidecar(tmp_path / "m.yaml")
    whole = one(path)
    subprocess.run(["fpack", "-D", "-Y", path], check=True)
    (packed,) = recording_files([tmp_path])
    raw = one(packed)
    assert packed.name == "m.fits.fz" and sidecar_path(packed) == tmp_path / "m.yaml"
    assert np.array_equal(raw.adu, whole.adu) and raw.adu.dtype == whole.adu.dtype
    assert (raw.name, raw.header, raw.cards, raw.start_unix_s, raw.mode) == (
        whole.name,
        whole.header,
        whole.cards,
        whole.start_unix_s,
        whole.mode,
    )
    with packed.open("r+b") as stream:
        cube = next(hdu for hdu in stored_hdus(stream, packed) if "SPARTA_TT_CUBE" in hdu.label)
        stream.seek(cube.begin + cube.size - 1)
        last = stream.read(1)
        stream.seek(cube.begin + cube.size - 1)
        stream.write(bytes([last[0] ^ 1]))
    with pytest.raises(InputDataError, match="do not fit their DATASUM"):
        read_recordings(packed, IRLOS)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.fits", gzip.compress(WHOLE)),
        ("a.fits.bz2", bz2.compress(WHOLE)),
        ("a.fits.xz", lzma.compress(WHOLE)),
        ("a.fits.gz", bz2.compress(WHOLE)),
        ("a.FITS.GZ", WHOLE),
        ("a.fits.gz", gzip.compress(gzip.compress(WHOLE))),
        ("a.fts.gz", gzip.compress(WHOLE[:4000]) + gzip.compress(WHOLE[4000:])),
        ("a.fits (1)", WHOLE),
        ("a.dat", gzip.compress(WHOLE)),
        ("a.fits", WHOLE + b" " * BLOCK),
        ("a.fits.gz", gzip.compress(WHOLE + b" " * 100)),
        ("a.fits", WHOLE[: BLOCK + CUBE.nbytes]),
    ],
)
def test_content_tells_how_a_file_is_packed_and_where_it_ends(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    assert np.array_equal(one(tmp_path / name).adu, CUBE)


def zipped() -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("a.fits", WHOLE)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "empty"),
        (b"\x1f\x9d\x90" + bytes(50), r"packed by compress \(\.Z\).*gzip -d"),
        (zipped(), "a zip archive"),
        (b"\n<!DOCTYPE html><html>", "a web page"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
        (b"\xef\xbb\xbf" + WHOLE, "byte order mark"),
        (b"\x89HDF\r\n\x1a\n", "an HDF5 file"),
        (gzip.compress(WHOLE)[:-100], "packed, and cut off or damaged"),
        (bz2.compress(WHOLE)[:-10], "packed, and cut off or damaged"),
        (lzma.compress(WHOLE)[:-10], "packed, and cut off or damaged"),
        (WHOLE[:-BLOCK], "truncated"),
        (WHOLE.replace(b" T / conforms", b" F / conforms"), "SIMPLE = F"),
    ],
)
def test_what_is_no_data_file_is_named(tmp_path, content, what):
    (tmp_path / "a.fits").write_bytes(content)
    with pytest.raises(InputDataError, match=what):
        read_recordings(tmp_path / "a.fits", IRLOS)


@pytest.mark.slow
def test_thousands_of_hdus_and_of_cards_are_refused_at_once(tmp_path):
    extension = written(fits.PrimaryHDU(), fits.ImageHDU(), checksum=False)[BLOCK:]
    (tmp_path / "hdus.fits").write_bytes(WHOLE + 6000 * extension)
    with pytest.raises(InputDataError, match="more than 5000 HDUs"):
        read_recordings(tmp_path / "hdus.fits", IRLOS)
    cards = b"".join(f"K{number:07d}= 1".encode().ljust(80) for number in range(250_000))
    (tmp_path / "cards.fits").write_bytes(WHOLE[:240] + cards)
    with pytest.raises(InputDataError, match="headers of more than 209715 cards"):
        read_recordings(tmp_path / "cards.fits", IRLOS)


def with_cards(*cards: bytes) -> bytes:
    whole = written(fits.PrimaryHDU(CUBE), checksum=False)
    end = whole.index(b"END" + b" " * 77)
    header = whole[:end] + b"".join(card.ljust(80) for card in (*cards, b"END"))
    return header.ljust(-(-len(header) // BLOCK) * BLOCK) + whole[-(-CUBE.nbytes // BLOCK) * -BLOCK :]


@pytest.mark.parametrize(
    "card",
    [
        b"HIERARCH ESO TEL AMBI FWHM START = nan",
        b"HIERARCH ESO TEL ALT = 60,5",
        b"OBJECT  = HD 12345",
        b"GAIN    = -INF",
        b"EXTNAME = SCI",
        b"FILTER  =K",
        b"CONTINUE  nothing",
        b"DATE-OBS= 2021-05-01",
    ],
)
def test_a_card_that_cannot_be_read_is_left_out_and_named(tmp_path, card):
    (tmp_path / "a.fits").write_bytes(with_cards(card))
    raw = one(tmp_path / "a.fits")
    text = " ".join(card.decode().removeprefix("HIERARCH ").split())
    assert np.array_equal(raw.adu, CUBE) and not raw.header and not raw.cards
    assert raw.warnings == (f"{tmp_path / 'a.fits'}: cards that cannot be read are left out: '{text}'",)


def test_a_card_that_cannot_be_read_is_an_error_where_the_data_depend_on_it(tmp_path):
    content = with_cards().replace(b"BZERO   =                32768", b"BZERO   =                  nan")
    (tmp_path / "a.fits").write_bytes(content)
    with pytest.raises(
        InputDataError, match="the card 'BZERO = nan' cannot be read, and the data depend on it"
    ):
        read_recordings(tmp_path / "a.fits", IRLOS)


CARD = 80
COUNTED = np.arange(4000, dtype=np.int32).reshape(10, 20, 20) // 50


def with_card(content: bytes, key: str, value: int) -> bytes:
    """A file with another value of a key."""
    place = content.index(f"{key:<8}= ".encode())
    return content[:place] + f"{key:<8}= {value:>20}".ljust(CARD).encode() + content[place + CARD :]


@pytest.fixture
def path(tmp_path):
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(COUNTED)]).writeto(tmp_path / "a.fits", checksum=True)
    return tmp_path / "a.fits"


def refusal(path) -> str:
    with pytest.raises(InputDataError) as caught, open_fits(path) as hdus:
        assert hdus[1].data is not None
    return str(caught.value)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda whole: whole[:-2880] + bytes([whole[-2880] ^ 1]) + whole[-2879:],
            "data do not fit their DATASUM",
        ),
        (lambda whole: whole + b"x" * 100, "something follows HDU 1 that is no extension"),
        (lambda whole: gzip.compress(with_card(whole, "NAXIS3", 10**9)), "truncated, or a wrong header"),
    ],
)
def test_data_that_contradict_checksum_or_header_are_refused(path, spoil, message):
    path.write_bytes(spoil(path.read_bytes()))
    assert message in refusal(path)


@pytest.mark.parametrize("name", ["a.fits", "a.fits.gz"])
@pytest.mark.parametrize("key", ["NAXIS", "TFIELDS"])
def test_headers_with_billions_of_axes_or_columns_are_refused_at_once(tmp_path, name, key):
    columns = [fits.Column("x", "J", array=np.arange(3))]
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns)]).writeto(tmp_path / "whole.fits")
    content = with_card((tmp_path / "whole.fits").read_bytes(), key, 2**31)
    (tmp_path / name).write_bytes(gzip.compress(content) if name.endswith("gz") else content)
    assert f"{key} = 2147483648 in a header, FITS allows 999" in refusal(tmp_path / name)


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress])
def test_few_bytes_that_unpack_to_many_are_refused_while_they_are_unpacked(tmp_path, monkeypatch, pack):
    monkeypatch.setattr("irlos_pipe.files.regular.MAX_UNPACKED_BYTES", 2**21)
    fits.writeto(tmp_path / "whole.fits", np.zeros((200, 64, 64)))
    (tmp_path / "a.fits").write_bytes(pack((tmp_path / "whole.fits").read_bytes()))
    assert "that unpack to more than 2097152" in refusal(tmp_path / "a.fits")


def test_random_groups_are_named(tmp_path):
    groups = fits.GroupData(
        np.zeros((3, 1, 1, 4), np.float32), bitpix=-32, parnames=["U"], pardata=[np.zeros(3)]
    )
    fits.GroupsHDU(groups).writeto(tmp_path / "a.fits")
    with pytest.raises(InputDataError, match="random groups"):
        read_recordings(tmp_path / "a.fits", IRLOS)
