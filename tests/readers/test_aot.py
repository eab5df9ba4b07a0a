"""AOT files, through the optional package aotpy."""

import numpy as np
import pytest

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.find import read_recordings

IRLOS = load_instrument("irlos")
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
