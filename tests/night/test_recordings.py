"""What the night learns of recordings from their files, and remembers."""

import os

import numpy as np
import pytest
from helpers.sparta_files import (
    FULL_PUPIL,
    TWO_BY_TWO,
    counts,
    loop_table,
    quadrants,
    star,
    write_muse,
    write_recorder,
    write_sidecar,
)

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.night import recordings as module
from irlos_pipe.night.database import opened
from irlos_pipe.readers.sidecar import AcquisitionKeys

PIXELS = counts(star(12, 12), frames=3)
TIMES = {"Seconds": 1707620400 + np.arange(3), "USeconds": np.zeros(3, int)}  # 2024-02-11 03:00 UTC


def discovered(folder, tree=None, keys=None):
    with opened(tree or folder.parent) as database:
        return module.discover([folder], keys or AcquisitionKeys(), load_instrument("irlos"), database)


def found(*arguments, **options):
    return discovered(*arguments, **options)[0]


def test_a_recorder_folder_is_described_by_side_car_and_table(tmp_path):
    write_recorder(tmp_path / "n/cube", PIXELS, times=TIMES)
    (one,) = found(tmp_path / "n")
    assert (one.path, one.name, one.role) == (tmp_path / "n/cube", "cube", "ncpa_calibration")
    assert (one.night, one.start_unix_s, one.frames, one.window) == ("2024-02-10", 1707620400.0, 3, (12, 12))
    assert one.configuration == "9.7 mas per pixel, lens, Noll 6 -170 nm" and one.spectrum == "1600 nm (1)"


def test_raw_files_of_one_folder_are_separate_inputs_and_2x2_modes_are_recognised(tmp_path):
    folder = tmp_path / "n"
    folder.mkdir()
    write_muse(folder / "full.fits", PIXELS, FULL_PUPIL)
    write_muse(folder / "four.fits", quadrants([PIXELS] * 4), TWO_BY_TWO)
    write_sidecar(folder / "acquisition.yaml")
    four, full = found(folder)
    assert (full.path, full.full_pupil, full.night) == (folder / "full.fits", True, "2023-07-13")
    assert (four.path, four.full_pupil, four.name) == (folder / "four.fits", False, "four")
    assert full.configuration.startswith(FULL_PUPIL)


@pytest.mark.parametrize(
    ("name", "night"),
    [
        ("2023-07-13", "2023-07-13"),
        ("2020-01-01/IRLOS_20230713_a/cube_12345678", "2023-07-13"),  # the nearest dated folder counts
        ("2023-99-99", None),
    ],
)
def test_a_recording_without_times_has_the_date_of_its_folder_or_else_of_its_file(tmp_path, name, night):
    path = write_recorder(tmp_path / name / "cube", PIXELS)
    os.utime(path, (1700000000, 1700000000))  # 2023-11-14 22:13 UTC
    (one,) = found(tmp_path / name)
    assert (one.start_unix_s, one.night) == (None, night or "2023-11-14")
    assert one.night_by == ("the date in its path" if night else "the date of its file")


def test_an_unreadable_recording_does_not_hide_the_others(tmp_path, monkeypatch):
    write_recorder(tmp_path / "n/good", PIXELS, times=TIMES)
    torn = write_recorder(tmp_path / "n/torn", PIXELS)
    torn.write_bytes(torn.read_bytes()[:4000])
    silent = write_recorder(tmp_path / "n/silent", PIXELS)
    write_sidecar(silent.with_name("acquisition.yaml"), "role")
    write_recorder(tmp_path / "n/breaks", PIXELS)
    read = module.read_sources

    def breaks(inputs, *rest):
        if inputs["night"][0].stem == "breaks":
            raise ZeroDivisionError("a bug")
        return read(inputs, *rest)

    monkeypatch.setattr(module, "read_sources", breaks)
    recordings, left_out = discovered(tmp_path / "n")
    assert [one.name for one in recordings] == ["good"]
    problems = {one.recording.path.stem: one.reason for one in left_out}
    assert list(problems) == ["breaks", "silent", "torn"] and "\n" not in problems["torn"]
    assert "key 'role' missing" in problems["silent"]
    assert "breaks.fits: unexpected ZeroDivisionError: a bug" in problems["breaks"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_folder_that_may_not_be_read_is_named_and_the_others_are_searched(tmp_path):
    write_recorder(tmp_path / "n/good", PIXELS)
    (tmp_path / "n/closed").mkdir(mode=0)
    recordings, (closed,) = discovered(tmp_path / "n")
    assert [one.name for one in recordings] == ["good"] and "no permission" in closed.reason


def test_keys_of_the_settings_override_the_side_car(tmp_path):
    write_recorder(tmp_path / "n/cube", PIXELS)
    (one,) = found(tmp_path / "n", keys=AcquisitionKeys(role="psf"))
    assert one.role == "psf"


def test_a_recording_is_read_once_and_again_when_it_or_its_side_car_changes(tmp_path, monkeypatch):
    path = write_recorder(tmp_path / "n/cube", PIXELS, times=TIMES)
    first, reads, read = found(tmp_path / "n"), [], module.read_sources

    def counted(*arguments):
        reads.append(1)
        return read(*arguments)

    monkeypatch.setattr(module, "read_sources", counted)
    assert found(tmp_path / "n") == first and not reads
    write_sidecar(path.with_name("acquisition.yaml"), role="psf", mag_j=9.25)
    assert found(tmp_path / "n")[0].role == "psf" and len(reads) == 1


def test_a_loop_table_that_arrives_later_gives_the_times(tmp_path):
    path = write_recorder(tmp_path / "n/cube", PIXELS)
    assert found(tmp_path / "n")[0].start_unix_s is None
    loop_table(20 * np.arange(3), TIMES["Seconds"], TIMES["USeconds"]).writeto(path.with_name("loop.fits"))
    assert found(tmp_path / "n")[0].start_unix_s == TIMES["Seconds"][0]


def test_an_empty_folder_has_nothing_and_an_absent_one_is_an_error(tmp_path):
    (tmp_path / "n").mkdir()
    assert discovered(tmp_path / "n") == ([], [])
    with pytest.raises(InputDataError, match="no such file or folder"):
        found(tmp_path / "absent", tmp_path)
