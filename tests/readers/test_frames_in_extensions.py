"""Which images of a file are the recording: known by shape and name, never by place."""

import numpy as np
import pytest
from astropy.io import fits
from helpers.sparta_files import counts, star

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.find import read_recordings
from irlos_pipe.readers.times import frames_missing

IRLOS = load_instrument("irlos")
CUBE = counts(star(12, 10), 6)
FLAT = np.ones((12, 10), np.float32)


def image(data, name="", ver=1):
    return fits.ImageHDU(data, name=name, ver=ver)


def read(tmp_path, *hdus, primary=None):
    path = tmp_path / "a.fits"
    fits.HDUList([fits.PrimaryHDU(primary), *hdus]).writeto(path, overwrite=True)
    (raw,) = read_recordings(path, IRLOS)
    return raw


def frames(name, first=1):
    return [image(frame, name.format(i), i) for i, frame in enumerate(CUBE, first)]


@pytest.mark.parametrize("name", ["SCI", "", "FRAME{}", "FRAME_{:03d}", "x{}"])
def test_a_frame_per_extension_is_a_cube(tmp_path, name):
    raw = read(tmp_path, *frames(name))
    assert np.array_equal(raw.adu, CUBE) and raw.warnings == () and frames_missing(raw.frame_counter) == 0


def test_frames_are_in_the_order_of_their_numbers_and_a_gap_is_a_lost_frame(tmp_path):
    assert np.array_equal(read(tmp_path, *frames("SCI")[::-1]).adu, CUBE)
    raw = read(tmp_path, *frames("SCI")[:2], *frames("SCI")[3:])
    assert raw.frames == 5 and frames_missing(raw.frame_counter) == 1


@pytest.mark.parametrize(
    ("hdus", "primary", "unread"),
    [
        ([image(CUBE, "SCI")], CUBE[0, ::2, ::2].copy(), "PRIMARY"),
        ([image(CUBE, "SCI")], CUBE[0], "PRIMARY"),
        ([image(FLAT.astype(np.uint8), "DQ"), image(CUBE, "SCI")], None, "DQ"),
        ([image(FLAT.astype(np.uint8)), image(CUBE)], None, "without a name"),
        ([image(CUBE, "DATA"), image(CUBE, "STAT"), image(CUBE, "DQ")], None, "STAT, DQ"),
        ([image(CUBE, "MODEL")], CUBE, "MODEL"),
        ([image(np.arange(9.0), "SPECTRUM"), image(CUBE)], None, "SPECTRUM"),
        (frames("SCI"), CUBE[0], "PRIMARY"),
        (
            [one for pair in zip(frames("SCI"), frames("ERR"), strict=True) for one in pair],
            None,
            r"ERR \(6\)",
        ),
    ],
)
def test_what_is_not_the_recording_is_named(tmp_path, hdus, primary, unread):
    raw = read(tmp_path, *[hdu.copy() for hdu in hdus], primary=primary)
    assert np.array_equal(raw.adu, CUBE)
    (line,) = raw.warnings
    assert line.endswith(f"images that are not read: {unread}".replace("\\", ""))


@pytest.mark.parametrize(
    "hdus",
    [
        [image(CUBE), image(CUBE)],
        [image(CUBE, "A"), image(CUBE, "B")],
        [image(CUBE[0], "A"), image(CUBE[0], "B")],
        [image(CUBE[0], "SCI"), image(CUBE[0, :8], "SCI", 2)],
        [image(CUBE[0]), image(CUBE[1]), image(CUBE[0, :8])],
        [image(frame, f"CCD{i}") for i, frame in enumerate(CUBE)],
    ],
)
def test_images_that_could_each_be_the_recording_are_an_error_that_names_them(tmp_path, hdus):
    with pytest.raises(InputDataError, match=r"that could each be the recording: HDU 1.*HDU 2"):
        read(tmp_path, *[hdu.copy() for hdu in hdus])
