"""Raw files of MUSE: cube, modes, quadrants, header and side tables."""

import numpy as np
import pytest
from helpers.sparta_files import TWO_BY_TWO, quadrants, write_muse

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.find import read_recordings
from irlos_pipe.readers.muse_raw import without_borders

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
