"""Searching folders, telling layouts apart, and files that are damaged."""

import os

import numpy as np
import pytest
from astropy.io import fits
from helpers.sparta_files import counts, star, write_muse, write_recorder

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.find import read_recordings, recording_files, unique_name

IRLOS = load_instrument("irlos")
CUBE = counts(star(12, 10), 3)


def one(path):
    (raw,) = read_recordings(path, IRLOS)
    return raw


def test_every_layout_is_recognised_by_its_content(tmp_path):
    fits.writeto(tmp_path / "plain.fits", CUBE)
    paths = [
        write_recorder(tmp_path / "rec", CUBE),
        write_muse(tmp_path / "muse.fits", CUBE),
        tmp_path / "plain.fits",
    ]
    assert [one(path).layout for path in paths] == ["sparta_recorder", "muse_raw", "fits_cube"]


def test_a_plain_cube_may_be_a_cube_an_image_or_an_extension(tmp_path):
    fits.writeto(tmp_path / "cube.fits", CUBE)
    fits.writeto(tmp_path / "image.fits", CUBE[0])
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(CUBE, name="DATA")]).writeto(tmp_path / "extension.fits")
    assert np.array_equal(one(tmp_path / "cube.fits").adu, CUBE)
    assert np.array_equal(one(tmp_path / "image.fits").adu, CUBE[:1])
    assert np.array_equal(one(tmp_path / "extension.fits").adu, CUBE)
    assert one(tmp_path / "cube.fits").adu.dtype.isnative


def test_a_folder_is_searched_in_natural_order_and_depth(tmp_path):
    for name in ("ramp/offset_10", "ramp/offset_2", "ramp/offset_1", ".hidden"):
        write_recorder(tmp_path / name, CUBE)
    fits.writeto(tmp_path / "a.fits", CUBE)
    assert [path.name for path in recording_files([tmp_path])] == [
        "a.fits",
        "offset_1.fits",
        "offset_2.fits",
        "offset_10.fits",
    ]


def test_equal_names_are_reported_apart_by_their_folders(tmp_path):
    assert (
        unique_name("offset_00", tmp_path / "b" / "offset_00" / "x.fits", {"offset_00"})
        == "offset_00-offset_00"
    )
    taken = {"x", "b-x", "a-x"}
    assert unique_name("x", tmp_path / "a" / "b" / "x.fits", taken) == "x-2"
    assert unique_name("x", tmp_path / "a" / "b" / "x.fits", {*taken, "x-2"}) == "x-3"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("text.fits", b"these are not the data", "not a FITS file"),
        ("cube.npy", b"\x93NUMPY", "not a FITS file"),
    ],
)
def test_a_file_of_another_kind_is_refused(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputDataError, match=message):
        [read_recordings(path, IRLOS) for path in recording_files([tmp_path / name])]


def test_a_path_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(InputDataError, match=r"gone: no such file or folder"):
        recording_files([tmp_path / "gone"])


@pytest.mark.parametrize(
    "write",
    [
        lambda folder: write_recorder(folder / "rec", CUBE),
        lambda folder: write_muse(folder / "m.fits", CUBE),
        lambda folder: fits.writeto(folder / "c.fits", CUBE) or folder / "c.fits",
    ],
)
@pytest.mark.parametrize("kept", [0.02, 0.3, 0.6, 0.7])
def test_a_truncated_file_is_refused_wherever_it_ends(tmp_path, write, kept):
    path = write(tmp_path)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(InputDataError, match=path.name) as caught:
        read_recordings(path, IRLOS)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("size", ["9999999", "-5", "0"])
def test_axes_that_cannot_be_are_refused_before_memory_is_asked_for(tmp_path, size):
    path = tmp_path / "c.fits"
    fits.writeto(path, CUBE)
    content = path.read_bytes()
    path.write_bytes(
        content.replace(b"NAXIS1  =                   10", b"NAXIS1  = " + size.rjust(20).encode(), 1)
    )
    with pytest.raises(InputDataError, match=r"c\.fits"):
        read_recordings(path, IRLOS)


def test_a_file_that_may_not_be_read_is_named(tmp_path, monkeypatch):
    fits.writeto(tmp_path / "c.fits", CUBE)
    (tmp_path / "c.fits").chmod(0)
    if os.access(tmp_path / "c.fits", os.R_OK):  # the superuser may read everything

        def refuse(*_, **__):
            raise PermissionError(13, "Permission denied")

        monkeypatch.setattr("irlos_pipe.files.regular.open_regular", refuse)
    with pytest.raises(InputDataError, match=r"c\.fits: no permission to read it"):
        read_recordings(tmp_path / "c.fits", IRLOS)
