"""SPARTA recorder folders: pixel table, padding, times, calibration images."""

import numpy as np
import pytest
from astropy.io import fits
from helpers.sparta_files import counts, loop_table, pixel_table, star, write_recorder

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.find import read_recordings
from irlos_pipe.readers.times import frames_missing


def read(path):
    (raw,) = read_recordings(path, load_instrument("irlos"))
    return raw


def ramp_image(rows, columns, frames=3):
    """Pixel value 1000 * frame + 100 * y + x."""
    frame, y, x = np.indices((frames, rows, columns))
    return (1000 * frame + 100 * y + x).astype(np.float32)


@pytest.fixture
def cube():
    return ramp_image(6, 9)


def test_x_runs_fastest_and_padding_is_dropped(tmp_path, cube):
    raw = read(write_recorder(tmp_path / "rec", cube, pad=37))
    assert raw.window == (6, 9)
    assert np.array_equal(raw.adu, cube)
    assert raw.adu[2, 5, 8] == 2508


@pytest.mark.parametrize(("seconds", "microseconds"), [("Seconds", "USeconds"), ("Sec", "USec")])
def test_time_columns_are_read_in_both_spellings(tmp_path, cube, seconds, microseconds):
    times = {seconds: [1700000000, 1700000000, 1700000001], microseconds: [500000, 600000, 0]}
    raw = read(write_recorder(tmp_path / "rec", cube, times=times))
    assert raw.unix_s - 1700000000 == pytest.approx([0.5, 0.6, 1.0], abs=1e-6)
    assert raw.start_unix_s == pytest.approx(1700000000.5, abs=1e-6)


def place_in_same_file(folder, cube, loop):
    return write_recorder(folder / "rec", cube, loop, counter=[100, 120, 140])


def place_beside(folder, cube, loop):
    path = write_recorder(folder / "rec", cube, counter=[100, 120, 140])
    fits.HDUList([fits.PrimaryHDU(), loop]).writeto(path.with_name("loop.fits"))
    return path


def place_in_loop_folder(folder, cube, loop):
    (folder / "rec_IR").mkdir()
    fits.HDUList([fits.PrimaryHDU(), loop]).writeto(folder / "rec_IR" / "rec_IR.fits")
    return write_recorder(folder / "rec_IR_PIX", cube, counter=[100, 120, 140])


@pytest.mark.parametrize("place", [place_in_same_file, place_beside, place_in_loop_folder])
def test_times_come_from_the_loop_table_by_exact_counter(tmp_path, cube, place):
    loop_counter = np.setdiff1d(np.arange(90, 160), [120])  # the loop lost frame 120
    loop = loop_table(loop_counter, np.full(69, 1700000000), 5000 * loop_counter)
    raw = read(place(tmp_path, cube, loop))
    assert raw.unix_s[[0, 2]] - 1700000000 == pytest.approx([0.5, 0.7], abs=1e-6)
    assert np.isnan(raw.unix_s[1])
    assert any("1 of 3 frames not found" in note for note in raw.notes)


@pytest.mark.parametrize(
    ("counter", "missing"),
    [([0, 20, 40, 60], 0), ([0, 20, 60, 80], 1), ([5, 6, 7, 11, 12], 3), ([0, 20, 20, 40], 0), ([7], 0)],
)
def test_a_lost_frame_is_counted_as_missing(counter, missing):
    assert frames_missing(np.array(counter)) == missing


def test_a_window_that_changes_is_refused_and_the_row_named(tmp_path, cube):
    path = write_recorder(tmp_path / "rec", cube, sizes=([9, 9, 8], [6, 6, 6]))
    with pytest.raises(InputDataError, match=r"window changes from 9x6 to 8x6 \(x, y\) px in row 3"):
        read(path)


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        (([9] * 3, [7] * 3), "needs 63 values, column 'Pixels' holds 54"),
        (([0] * 3, [6] * 3), "a window of 0x6"),
        (([2] * 3, [6] * 3), "expected 5 to 4096 px a side"),
    ],
)
def test_a_window_that_cannot_be_is_refused(tmp_path, cube, sizes, message):
    with pytest.raises(InputDataError, match=message):
        read(write_recorder(tmp_path / "rec", cube, sizes=sizes))


@pytest.mark.parametrize("name", ["FrameCounter", "WindowSizeX", "WindowSizeY", "Pixels"])
def test_a_missing_column_is_named(tmp_path, cube, name):
    path = write_recorder(tmp_path / "rec", cube)
    table = pixel_table(cube)
    kept = fits.BinTableHDU.from_columns([c for c in table.columns if c.name != name], name="IRPixelFrame")
    fits.HDUList([fits.PrimaryHDU(), kept]).writeto(path, overwrite=True)
    with pytest.raises(InputDataError, match=rf"HDU 1 \(IRPIXELFRAME\): no column '{name}'"):
        read(path)


def test_vectors_of_varying_length_are_refused(tmp_path, cube):
    path = write_recorder(tmp_path / "rec", cube)
    vectors = np.empty(3, dtype=object)
    vectors[:] = [np.arange(54, dtype=np.float32)] * 3
    others = [c for c in pixel_table(cube).columns if c.name != "Pixels"]
    table = fits.BinTableHDU.from_columns(
        [*others, fits.Column("Pixels", "PE()", array=vectors)], name="IRPixelFrame"
    )
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(path, overwrite=True)
    with pytest.raises(InputDataError, match="varying length"):
        read(path)


def test_calibration_images_beside_the_table_are_read(tmp_path, cube):
    dark, sky, flat = (np.full((6, 9), value) for value in (6.0, 2.0, 0.9))
    dead, weight = np.zeros((6, 9)), np.ones((6, 9))
    dead[1, 2], weight[3, 4] = 1, 0
    maps = {"DARK": dark, "BACKGROUND": sky, "FLAT": flat, "DEAD": dead, "WEIGHT": weight}
    found = read(write_recorder(tmp_path / "rec", cube, maps=maps)).calibration
    assert (found.dark_adu == 6).all() and (found.background_adu == 2).all()
    assert found.flat == pytest.approx(0.9)
    assert np.argwhere(found.bad).tolist() == [[1, 2], [3, 4]]


def test_a_stack_of_darks_is_averaged_and_its_noise_known(tmp_path):
    darks = np.random.default_rng(0).normal(50, 4, (100, 32, 32))
    maps = read(write_recorder(tmp_path / "rec", counts(star()), maps={"DARK": darks})).calibration
    assert maps.dark_adu.mean() == pytest.approx(50, abs=0.1)
    assert maps.dark_variance_adu2 == pytest.approx(16 / 100, rel=0.1)


def test_a_calibration_image_of_another_size_is_refused(tmp_path, cube):
    path = write_recorder(tmp_path / "rec", cube, maps={"DARK": np.zeros((9, 9))})
    with pytest.raises(
        InputDataError, match=r"IRAcq\.DET1\.DARK\.fits.*9x9 \(y, x\) px do not fit the window of 6x9"
    ):
        read(path)


def test_a_map_of_dead_pixels_upside_down_is_refused(tmp_path, cube):
    with pytest.raises(InputDataError, match="marks 54 of 54 pixels as dead"):
        read(write_recorder(tmp_path / "rec", cube, maps={"DEAD": np.ones((6, 9))}))
