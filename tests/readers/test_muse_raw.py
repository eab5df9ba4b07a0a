"""Raw files of MUSE: cube, modes, quadrants, header and side tables."""

import numpy as np
import pytest
from astropy.io import fits
from helpers.sparta_files import (
    TWO_BY_TWO,
    counts,
    loop_table,
    pixel_table,
    quadrants,
    star,
    write_muse,
    write_recorder,
)

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.find import read_recordings
from irlos_pipe.readers.muse_raw import without_borders
from irlos_pipe.readers.times import frames_missing, relative_times

IRLOS = load_instrument("irlos")


def numbered(frames, rows, columns, offset=0):
    frame, y, x = np.indices((frames, rows, columns))
    return (offset + 1 + 1000 * frame + 100 * y + x).astype(np.uint16)


def test_the_header_gives_what_it_knows(tmp_path):
    header = {
        "ESO SEQ NGS MAG": 10.5,
        "ESO TEL AMBI FWHM START": 0.7,
        "ESO TEL PARANG START": 35.2,
        "ESO TEL ALT": 62.0,
        "ESO INS DROT START": 81.4,
        "OBJECT": "HD 1",
    }
    (raw,) = read_recordings(write_muse(tmp_path / "m.fits", numbered(2, 8, 8), header=header), IRLOS)
    expected = {
        "mag_j": 10.5,
        "seeing_arcsec": 0.7,
        "parallactic_angle_deg": 35.2,
        "altitude_deg": 62.0,
        "derotator_angle_deg": 81.4,
        "target": "HD 1",
    }
    of_mode = {"frame_rate_hz": 200.0, "exposure_s": 0.005, "pixel_scale_mas": 9.7}
    assert {key: raw.header[key] for key in expected} == expected
    assert {key: raw.of_mode[key] for key in of_mode} == of_mode
    assert not of_mode.keys() & raw.header.keys()
    assert raw.start_unix_s == 1689304870.0  # 2023-07-14T03:21:10 UTC


def test_an_unknown_mode_is_named(tmp_path):
    path = write_muse(tmp_path / "m.fits", numbered(2, 8, 8), mode="64x64_FullPupl_200Hz_HighGain")
    with pytest.raises(
        InputDataError,
        match=r"'64x64_FullPupl_200Hz_HighGain' is no mode of irlos.*did you mean "
        r"'64x64_FullPupil_200Hz_HighGain'",
    ):
        read_recordings(path, IRLOS)


def test_the_images_of_a_2x2_mode_lie_side_by_side_without_their_borders(tmp_path):
    images = [numbered(3, 6, 8, offset) for offset in (0, 10000, 20000, 30000)]
    (raw,) = read_recordings(write_muse(tmp_path / "m.fits", quadrants(images), TWO_BY_TWO), IRLOS)
    assert (raw.name, raw.lenslets) == ("m", 2)
    assert np.array_equal(raw.adu[:, :6, :8], images[0]) and np.array_equal(raw.adu[:, :6, 8:], images[1])
    assert np.array_equal(raw.adu[:, 6:, :8], images[2]) and np.array_equal(raw.adu[:, 6:, 8:], images[3])


@pytest.mark.parametrize(
    ("day", "mode", "scale_mas", "e_per_adu"),
    [
        ("2023-01-01T00:00:00", "20x20_SmallScale_500Hz_HighGain", 78, 9.8 / 68),
        ("2023-01-01T00:00:00", "20x20_LargeScale_200Hz_LowGain", 314, 9.8),
        ("2021-03-19T00:00:00", "20x20_SmallScale_500Hz_HighGain", 60, 3.0),
        ("2019-01-01T00:00:00", "20x20_LargeScale_500Hz_HighGain", 242, 3.0),
    ],
)
def test_scale_and_gain_are_those_of_mode_and_day(tmp_path, day, mode, scale_mas, e_per_adu):
    path = write_muse(tmp_path / "m.fits", quadrants([numbered(1, 6, 6)] * 4), mode, {"DATE-OBS": day})
    (raw,) = read_recordings(path, IRLOS)
    assert raw.of_mode["pixel_scale_mas"] == scale_mas
    assert raw.of_mode["detector.e_per_adu"] == pytest.approx(e_per_adu)


def test_a_2x2_file_without_a_day_needs_a_side_car_that_states_scale_and_gain(tmp_path):
    path = write_muse(tmp_path / "m.fits", quadrants([numbered(1, 6, 6)] * 4), TWO_BY_TWO, {"DATE-OBS": ""})
    with pytest.raises(InputDataError, match=r"DATE-OBS is missing.*pixel_scale_mas and detector\.e_per_adu"):
        read_recordings(path, IRLOS)
    (tmp_path / "m.yaml").write_text("pixel_scale_mas: 60\ndetector: {e_per_adu: 3}\n")
    assert read_recordings(path, IRLOS)[0].lenslets == 2


def test_a_2x2_cube_without_borders_is_refused():
    with pytest.raises(InputDataError, match="quadrant 1 lacks the one-pixel border of zeros"):
        without_borders(numbered(2, 16, 16), "m.fits")


# AOT files, through the optional package aotpy.


CUBE = np.arange(3 * 8 * 9, dtype=np.float32).reshape(3, 8, 9)


def write_aot(path, **detector):
    aotpy = pytest.importorskip("aotpy")
    system = aotpy.AOSystem(ao_mode="LTAO", name="GALACSI")
    system.main_telescope = aotpy.MainTelescope(uid="UT4")
    time = aotpy.Time(uid="frames", timestamps=[100.0, 100.1, 100.2], frame_numbers=[7, 8, 10])
    pixels = aotpy.Image("pixels", CUBE, time=time)
    maps = {
        name: aotpy.Image(name, value) for name, value in detector.items() if isinstance(value, np.ndarray)
    }
    scalars = {name: value for name, value in detector.items() if name not in maps}
    system.scoring_cameras.append(
        aotpy.ScoringCamera(
            uid="camera", detector=aotpy.Detector(uid="IRLOS", pixel_intensities=pixels, **maps, **scalars)
        )
    )
    system.write_to_file(path)
    return path


@pytest.mark.filterwarnings("ignore")
def test_frames_times_and_constants_of_an_aot_file_are_read(tmp_path):
    (raw,) = read_recordings(
        write_aot(tmp_path / "a.fits", pixel_scale=9.7e-3 / 206264.806, frame_rate=10.0), IRLOS
    )
    assert raw.layout == "aot"
    assert np.array_equal(raw.adu, CUBE)
    assert raw.unix_s == pytest.approx([100.0, 100.1, 100.2])
    assert raw.frame_counter.tolist() == [7, 8, 10]
    assert raw.header["pixel_scale_mas"] == pytest.approx(9.7)
    assert raw.header["frame_rate_hz"] == 10.0


@pytest.mark.filterwarnings("ignore")
def test_the_flat_of_an_aot_file_is_the_inverse_of_the_response(tmp_path):
    path = write_aot(
        tmp_path / "a.fits",
        flat_field=np.full((8, 9), 1.25, np.float32),
        dark=np.full((8, 9), 3.0, np.float32),
    )
    maps = read_recordings(path, IRLOS)[0].calibration
    assert maps.flat == pytest.approx(0.8)
    assert (maps.dark_adu == 3).all()


@pytest.mark.filterwarnings("ignore")
def test_a_file_whose_detector_recorded_nothing_is_refused(tmp_path):
    aotpy = pytest.importorskip("aotpy")
    system = aotpy.AOSystem(ao_mode="LTAO", name="GALACSI")
    system.main_telescope = aotpy.MainTelescope(uid="UT4")
    system.write_to_file(tmp_path / "a.fits")
    with pytest.raises(InputDataError, match="no detector that looks at a star recorded its pixels"):
        read_recordings(tmp_path / "a.fits", IRLOS)


# SPARTA recorder folders: pixel table, padding, times, calibration images.


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


def test_a_recording_whose_first_frame_has_no_time_begins_with_the_first_that_has_one(tmp_path, cube):
    loop = loop_table(np.array([120, 140]), np.full(2, 1700000000), np.array([600_000, 700_000]))
    raw = read(place_in_same_file(tmp_path, cube, loop))
    assert raw.start_unix_s == pytest.approx(1700000000.6)


@pytest.mark.parametrize(
    ("counter", "missing"),
    [([0, 20, 40, 60], 0), ([0, 20, 60, 80], 1), ([5, 6, 7, 11, 12], 3), ([0, 20, 20, 40], 0), ([7], 0)],
)
def test_a_lost_frame_is_counted_as_missing(counter, missing):
    assert frames_missing(np.array(counter)) == missing


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"sizes": ([9, 9, 8], [6, 6, 6])}, r"window changes from 9x6 to 8x6 \(x, y\) px in row 3"),
        ({"sizes": ([9] * 3, [7] * 3)}, "needs 63 values, column 'Pixels' holds 54"),
        ({"sizes": ([0] * 3, [6] * 3)}, "a window of 0x6"),
        ({"sizes": ([2] * 3, [6] * 3)}, "expected 5 to 4096 px a side"),
        ({"adu": ramp_image(6, 9, 0)}, "no frames"),
        (
            {"maps": {"DARK": np.zeros((9, 9))}},
            r"IRAcq\.DET1\.DARK\.fits.*9x9 \(y, x\) px do not fit the window of 6x9",
        ),
        ({"maps": {"DEAD": np.ones((6, 9))}}, "marks 54 of 54 pixels as dead"),  # a map upside down
    ],
)
def test_a_recorder_folder_that_contradicts_itself_is_refused(tmp_path, cube, given, message):
    with pytest.raises(InputDataError, match=message):
        read(write_recorder(tmp_path / "rec", **{"adu": cube} | given))


VECTORS = np.empty(3, dtype=object)
VECTORS[:] = [np.arange(54, dtype=np.float32)] * 3


@pytest.mark.parametrize(
    ("name", "column", "message"),
    [
        *(
            (name, [], rf"HDU 1 \(IRPIXELFRAME\): no column '{name}'")
            for name in ("FrameCounter", "WindowSizeX", "WindowSizeY", "Pixels")
        ),
        ("Pixels", ["PE()", VECTORS], "varying length"),
        ("FrameCounter", ["2J", np.zeros((3, 2), int)], "'FrameCounter' has 2 values per row"),
        *(("Seconds", ["D", np.full(3, one)], "no time from 1970 to 2100") for one in (1e18, -5.0, np.nan)),
    ],
)
def test_a_pixel_table_whose_columns_cannot_be_is_refused(tmp_path, cube, name, column, message):
    path = write_recorder(tmp_path / "rec", cube)
    columns = [one for one in pixel_table(cube).columns if one.name != name]
    if column:
        columns.append(fits.Column(name, column[0], array=column[1]))
    table = fits.BinTableHDU.from_columns(columns, name="IRPixelFrame")
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(path, overwrite=True)
    with pytest.raises(InputDataError, match=message):
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


def test_frames_without_a_time_are_placed_by_their_counter():
    times = relative_times(np.array([10.0, np.nan, 10.4]), np.array([0, 20, 80]), frame_rate_hz=1.0)
    assert times == pytest.approx([0.0, 0.1, 0.4])


def test_weights_that_leave_a_small_window_are_no_bad_pixels(tmp_path, cube):
    weight = np.zeros((6, 9))
    weight[2:4, 3:6] = 1
    raw = read(write_recorder(tmp_path / "rec", cube, maps={"WEIGHT": weight}))
    assert raw.calibration.bad is None
    assert any("centroiding window" in note for note in raw.notes)
