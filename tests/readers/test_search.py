"""Folders with links, pipes, devices and torn files: nothing hangs, nothing counts twice or gets lost."""

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
from irlos_pipe.readers.find import each_once, files_by_folder, files_of, read_recordings, recording_files
from irlos_pipe.readers.fitsfile import open_fits, stored_hdus

IRLOS = load_instrument("irlos")
CUBE = counts(star(12, 12), 3)


@pytest.fixture(autouse=True)
def patient():
    with within(60):
        yield


def cut_behind_primary_header(path):
    path.write_bytes(path.read_bytes()[:2880])


def test_a_link_to_its_own_folder_does_not_multiply_a_recording(tmp_path):
    path = write_recorder(tmp_path / "rec", CUBE)
    for name in ("a", "z"):
        (path.parent / name).symlink_to(".")
    assert recording_files([tmp_path]) == [path]


def test_links_to_folders_elsewhere_are_followed_but_not_upwards(tmp_path):
    write_recorder(tmp_path / "store" / "rec", CUBE)
    (tmp_path / "night").mkdir()
    (tmp_path / "night" / "rec").symlink_to("../store/rec")
    (tmp_path / "night" / "up").symlink_to("..")
    assert recording_files([tmp_path / "night"]) == [tmp_path / "night" / "rec" / "rec.fits"]


@pytest.mark.parametrize(
    "write",
    [
        lambda folder: write_recorder(folder / "rec", CUBE),
        lambda folder: write_sidecar(folder / "acquisition.yaml") and write_muse(folder / "m.fits", CUBE),
        lambda folder: write_sidecar(folder / "m.yaml") and write_muse(folder / "m.fits", CUBE),
    ],
)
def test_a_recording_cut_off_behind_its_primary_header_is_reported(tmp_path, write):
    path = write(tmp_path)
    cut_behind_primary_header(path)
    assert recording_files([tmp_path]) == [path]
    with pytest.raises(InputDataError, match="no recording in it"):
        read_recordings(path, IRLOS)


@pytest.mark.parametrize("name", ["notes", "loop.fits", "IRAcq.DET1.DARK.fits"])
def test_a_pipe_in_the_folder_of_a_recording_is_not_opened(tmp_path, name):
    path = write_recorder(tmp_path / "rec", CUBE)
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
    path = write_recorder(tmp_path / "rec", CUBE)
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


def test_a_file_with_two_cubes_is_refused_but_not_one_with_a_named_map_beside_it(tmp_path):
    def cubes(name, *names):
        images = [fits.ImageHDU(CUBE, name=one) for one in names]
        fits.HDUList([fits.PrimaryHDU(), *images]).writeto(tmp_path / name)
        return tmp_path / name

    for path in (cubes("a.fits", "", ""), cubes("b.fits", "SCI", "SCI")):
        with pytest.raises(InputDataError, match="2 cubes of frames"):
            read_recordings(path, IRLOS)
    (raw,) = read_recordings(cubes("c.fits", "SCI", "ERR"), IRLOS)
    assert raw.frames == 3 and "ERR" in raw.warnings[0]


@pytest.mark.parametrize("seconds", [1e18, -5.0, np.nan])
def test_a_time_that_cannot_be_is_refused(tmp_path, seconds):
    table = pixel_table(CUBE)
    table = fits.BinTableHDU.from_columns(
        table.columns + fits.Column("Seconds", "D", array=np.full(3, seconds)), name="IRPixelFrame"
    )
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(tmp_path / "c.fits")
    with pytest.raises(InputDataError, match="is no time from 1970 to 2100"):
        read_recordings(tmp_path / "c.fits", IRLOS)


def test_a_frame_counter_with_several_values_per_frame_is_refused(tmp_path):
    table = pixel_table(CUBE)
    columns = [column for column in table.columns if column.name != "FrameCounter"]
    columns.append(fits.Column("FrameCounter", "2J", array=np.zeros((3, 2), int)))
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns, name="IRPixelFrame")]).writeto(
        tmp_path / "c.fits"
    )
    with pytest.raises(InputDataError, match="'FrameCounter' has 2 values per row"):
        read_recordings(tmp_path / "c.fits", IRLOS)


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
