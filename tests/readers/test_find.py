"""Searching folders, telling layouts apart, and files that are damaged."""

import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from conftest import invoke
from helpers.patience import within
from helpers.sparta_files import (
    counts,
    pixel_table,
    star,
    write_muse,
    write_recorder,
    write_sidecar,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.files.regular import open_unpacked
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.find import (
    each_once,
    files_by_folder,
    files_of,
    read_recordings,
    recording_files,
    unique_name,
)
from irlos_pipe.readers.fitsfile import open_fits, stored_hdus
from irlos_pipe.readers.times import frames_missing

IRLOS = load_instrument("irlos")
CUBE = counts(star(12, 10), 3)


def one(path):
    (raw,) = read_recordings(path, IRLOS)
    return raw


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


# Which images of a file are the recording: known by shape and name, never by place.


SIX = counts(star(12, 10), 6)
FLAT = np.ones((12, 10), np.float32)


def image(data, name="", ver=1):
    return fits.ImageHDU(data, name=name, ver=ver)


def read(tmp_path, *hdus, primary=None):
    path = tmp_path / "a.fits"
    fits.HDUList([fits.PrimaryHDU(primary), *hdus]).writeto(path, overwrite=True)
    (raw,) = read_recordings(path, IRLOS)
    return raw


def frames(name, first=1):
    return [image(frame, name.format(i), i) for i, frame in enumerate(SIX, first)]


@pytest.mark.parametrize("name", ["SCI", "", "FRAME{}", "FRAME_{:03d}", "x{}"])
def test_a_frame_per_extension_is_a_cube(tmp_path, name):
    raw = read(tmp_path, *frames(name))
    assert np.array_equal(raw.adu, SIX) and not raw.warnings and frames_missing(raw.frame_counter) == 0


def test_frames_are_in_the_order_of_their_numbers_and_a_gap_is_a_lost_frame(tmp_path):
    assert np.array_equal(read(tmp_path, *frames("SCI")[::-1]).adu, SIX)
    raw = read(tmp_path, *frames("SCI")[:2], *frames("SCI")[3:])
    assert raw.frames == 5 and frames_missing(raw.frame_counter) == 1


@pytest.mark.parametrize(
    ("hdus", "primary", "unread"),
    [
        ([image(SIX, "SCI")], SIX[0, ::2, ::2].copy(), "PRIMARY"),
        ([image(SIX, "SCI")], SIX[0], "PRIMARY"),
        ([image(FLAT.astype(np.uint8), "DQ"), image(SIX, "SCI")], None, "DQ"),
        ([image(FLAT.astype(np.uint8)), image(SIX)], None, "without a name"),
        ([image(SIX, "DATA"), image(SIX, "STAT"), image(SIX, "DQ")], None, "STAT, DQ"),
        ([image(SIX, "MODEL")], SIX, "MODEL"),
        ([image(np.arange(9.0), "SPECTRUM"), image(SIX)], None, "SPECTRUM"),
        (frames("SCI"), SIX[0], "PRIMARY"),
        ([one for pair in zip(frames("SCI"), frames("ERR"), strict=True) for one in pair], None, "ERR (6)"),
    ],
)
def test_what_is_not_the_recording_is_named(tmp_path, hdus, primary, unread):
    raw = read(tmp_path, *[hdu.copy() for hdu in hdus], primary=primary)
    assert np.array_equal(raw.adu, SIX)
    (line,) = raw.warnings
    assert line.endswith(f"images that are not read: {unread}")


@pytest.mark.parametrize(
    "hdus",
    [
        [image(SIX), image(SIX)],
        [image(SIX, "A"), image(SIX, "B")],
        [image(SIX[0], "A"), image(SIX[0], "B")],
        [image(SIX[0], "SCI"), image(SIX[0, :8], "SCI", 2)],
        [image(SIX[0]), image(SIX[1]), image(SIX[0, :8])],
        [image(frame, f"CCD{i}") for i, frame in enumerate(SIX)],
    ],
)
def test_images_that_could_each_be_the_recording_are_an_error_that_names_them(tmp_path, hdus):
    with pytest.raises(InputDataError, match=r"that could each be the recording: HDU 1.*HDU 2"):
        read(tmp_path, *[hdu.copy() for hdu in hdus])


# Folders with links, pipes, devices and torn files: nothing hangs, nothing counts twice or gets lost.


SEARCH_CUBE = counts(star(12, 12), 3)


@pytest.fixture(autouse=True)
def patient():
    with within(60):
        yield


def test_links_to_folders_elsewhere_are_followed_but_not_upwards(tmp_path):
    write_recorder(tmp_path / "store" / "rec", SEARCH_CUBE)
    (tmp_path / "night").mkdir()
    (tmp_path / "night" / "rec").symlink_to("../store/rec")
    (tmp_path / "night" / "up").symlink_to("..")
    assert recording_files([tmp_path / "night"]) == [tmp_path / "night" / "rec" / "rec.fits"]


@pytest.mark.parametrize(
    "write",
    [
        lambda folder: write_recorder(folder / "rec", SEARCH_CUBE),
        lambda folder: (
            write_sidecar(folder / "acquisition.yaml") and write_muse(folder / "m.fits", SEARCH_CUBE)
        ),
        lambda folder: write_sidecar(folder / "m.yaml") and write_muse(folder / "m.fits", SEARCH_CUBE),
    ],
)
def test_a_recording_cut_off_behind_its_primary_header_is_reported(tmp_path, write):
    path = write(tmp_path)
    path.write_bytes(path.read_bytes()[:2880])
    assert recording_files([tmp_path]) == [path]
    with pytest.raises(InputDataError, match="no recording in it"):
        read_recordings(path, IRLOS)


@pytest.mark.parametrize("name", ["notes", "loop.fits", "IRAcq.DET1.DARK.fits"])
def test_a_pipe_in_the_folder_of_a_recording_is_not_opened(tmp_path, name):
    path = write_recorder(tmp_path / "rec", SEARCH_CUBE)
    os.mkfifo(path.with_name(name))
    assert path in recording_files([tmp_path])
    assert read_recordings(path, IRLOS)[0].frames == 3
    assert path.with_name(name) not in files_of(path)


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: os.symlink("/dev/zero", path)])
def test_a_pipe_or_device_named_like_a_recording_is_reported(tmp_path, make):
    make(tmp_path / "c.fits")
    assert recording_files([tmp_path]) == [tmp_path / "c.fits"]
    with pytest.raises(InputDataError, match=r"c\.fits: not a regular file"):
        read_recordings(tmp_path / "c.fits", IRLOS)


@pytest.mark.parametrize("key", ["NAXIS2  ", "NAXIS1  ", "PCOUNT  "])
def test_a_size_below_zero_is_refused_at_once(tmp_path, key):
    path = write_recorder(tmp_path / "rec", counts(star(32, 32), 3))  # rows longer than a block
    content = path.read_bytes()
    at = content.index(key.encode() + b"=", 2880)
    path.write_bytes(content[:at] + f"{key}= {-1:>20}".encode() + content[at + 30 :])
    with pytest.raises(InputDataError, match="nothing below 0"):
        read_recordings(path, IRLOS)


def test_a_file_that_shrinks_while_it_is_read_is_an_error(tmp_path):
    path = write_recorder(tmp_path / "rec", SEARCH_CUBE)
    with pytest.raises(InputDataError, match="changed while it was read"), open_fits(path) as hdus:
        path.write_bytes(path.read_bytes()[:4000])
        np.asarray(hdus[1].data)


def test_headers_looked_at_while_the_file_is_cut_give_an_error_not_a_signal(tmp_path):
    """Through a memory map a page that is gone kills the process."""
    path = tmp_path / "c.fits"
    fits.writeto(path, np.zeros((300, 64, 64), np.float32))
    with open_unpacked(path) as stream:
        stream.read(4000)
        os.truncate(path, 4000)
        with pytest.raises(InputDataError, match="the file holds 1120: truncated"):
            stored_hdus(stream, path)


FOLDERS = st.sampled_from(["a", "b", "a/c", "b/d", "a/c/e"])
LINKS = st.tuples(
    FOLDERS, st.sampled_from("xyz"), st.sampled_from([".", "..", "../..", "a", "b/d", "gone", "x"])
)


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(files=st.sets(FOLDERS, min_size=1), links=st.lists(LINKS, max_size=8))
def test_every_file_is_found_once_and_links_give_way(files, links):
    with tempfile.TemporaryDirectory() as place, within(20):
        root = Path(place).resolve()
        for folder in ("a/c/e", "b/d"):
            (root / folder).mkdir(parents=True)
        for folder in files:
            (root / folder / "r.fits").touch()
        for where, name, target in links:
            link = root / where / name
            if not link.is_symlink():
                link.symlink_to(target if target in (".", "..", "gone", "x") else os.path.join(root, target))
        found = each_once([file for group, _ in files_by_folder(root, _refused) for file in group])
        assert sorted(found) == sorted(root / folder / "r.fits" for folder in files)


def _refused(folder: Path, error: Exception) -> None:
    raise error


STARS = counts(star(24, 24), 3)
RECIPE = "recipe: x\ninputs: {cube: in}\nstages: [ingest]\ningest: {acquisition: {role: psf}}\n"


@pytest.fixture
def ramp(tmp_path):
    for name in ("offset_0", "offset_1"):
        write_recorder(tmp_path / "in" / name, STARS + (name == "offset_1"))
    return tmp_path / "in"


@pytest.mark.slow
@pytest.mark.parametrize("end", [".part", ".crdownload", None])
def test_a_recording_that_is_gone_or_unfinished_is_told_by_its_side_car(ramp, tmp_path, end):
    data = ramp / "offset_1" / "offset_1.fits"
    beside = "nothing lies beside it" if end is None else f"beside it: offset_1.fits{end}"
    data.unlink() if end is None else data.rename(f"{data}{end}")
    first, lone = recording_files([ramp])
    assert first.name == "offset_0.fits" and lone == ramp / "offset_1" / "acquisition.yaml"
    with pytest.raises(InputDataError, match=f"no recording that could be read belongs to it; {beside}"):
        read_recordings(lone, IRLOS)
    (tmp_path / "r.yaml").write_text(RECIPE)
    assert beside in invoke("validate", str(tmp_path / "r.yaml")).stderr
    run = invoke("run", str(tmp_path / "r.yaml"), "--output", str(tmp_path / "out"))
    assert run.exit_code == 5 and beside in run.stdout
    plan = invoke("night", str(ramp), "--output", str(tmp_path / "tree"), "--dry-run")
    assert beside in plan.stdout and "offset_0" in plan.stdout


@pytest.mark.parametrize("shape", [(40,), (2, 3, 12, 12), (3, 2, 12)])
def test_axes_that_are_no_cube_are_refused(tmp_path, shape):
    fits.writeto(tmp_path / "c.fits", np.zeros(shape, np.float32))
    with pytest.raises(InputDataError, match=r"c\.fits: HDU 0 \(PRIMARY\): axes"):
        read_recordings(tmp_path / "c.fits", IRLOS)


def test_a_file_with_two_pixel_tables_is_refused(tmp_path):
    path = write_recorder(tmp_path / "rec", CUBE, pixel_table(CUBE))
    with pytest.raises(InputDataError, match="2 tables IRPixelFrame"):
        read_recordings(path, IRLOS)
