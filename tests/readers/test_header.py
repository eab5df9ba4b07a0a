"""What headers of any layout say: keywords of ESO, angles that turn the pupil, when a recording began.

Truth of the times: astropy's, and 1970 as MJD 40587.
"""

import numpy as np
import pytest
import yaml
from astropy.io import fits
from astropy.time import Time
from helpers.optics_cases import vector
from helpers.recordings import recording as made
from helpers.sparta_files import counts, sidecar, star, write_recorder

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.frames.recording import HEADER
from irlos_pipe.instrument.instrument import PROFILES, load_instrument
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.readers.acquisition import resolve
from irlos_pipe.readers.find import read_recordings
from irlos_pipe.readers.sidecar import AcquisitionKeys
from irlos_pipe.readers.times import start_of
from irlos_pipe.stages.base import ModelConfig
from irlos_pipe.stages.model.effects import psf_settings
from irlos_pipe.stages.model.groups import require_one_setup

STAMP = "2021-05-01T05:00:00"
UNIX_S = Time(STAMP, scale="utc").unix
MJD = Time(STAMP, scale="utc").mjd
HEADER_OF_PARANAL = {
    "ESO SEQ NGS MAG": 10.5,
    "ESO TEL AMBI FWHM START": 0.9,
    "ESO TEL PARANG START": 20.0,
    "ESO TEL ALT": 62.0,
    "ESO TEL AIRM START": 1.13,
    "ESO TEL AMBI PRES START": 744.0,
    "ESO INS DROT START": 7.0,
}
FROM_HEADER = {"mag_j", "parallactic_angle_deg", "altitude_deg", "pressure_hpa", "derotator_angle_deg"}


def turned_by(folder, **rule):
    """IRLOS whose pupil turns by a rule."""
    profile = yaml.safe_load((PROFILES / "irlos.yaml").read_text())
    profile["pupil"] = {"source": "a test", "status": "assumed", "turns": rule}
    path = folder / "turning.yaml"
    path.write_text(yaml.safe_dump(profile))
    return load_instrument(path)


@pytest.fixture
def turning(tmp_path):
    """IRLOS whose pupil turns with both angles."""
    return turned_by(tmp_path, offset_deg=10, parallactic=-1, derotator=2)


def cube(folder, header, *, extension=False):
    """A plain cube, in the primary HDU or behind it."""
    primary = fits.PrimaryHDU(None if extension else np.ones((2, 16, 16), np.float32))
    primary.header.update({f"HIERARCH {key}": value for key, value in header.items()})
    hdus = [primary, *([fits.ImageHDU(np.ones((2, 16, 16), np.float32))] if extension else [])]
    fits.HDUList(hdus).writeto(folder / "cube.fits", overwrite=True)
    return folder / "cube.fits"


def recorder(folder, header):
    path = write_recorder(folder / "rec", counts(star(16, 16)))
    (folder / "rec/acquisition.yaml").unlink()
    with fits.open(path, mode="update") as hdus:
        hdus[0].header.update({f"HIERARCH {key}": value for key, value in header.items()})
    return path


def resolved(path, instrument, **changes):
    """How the recording was taken, by a side-car's keys that stand in the recipe."""
    keys = {**sidecar("mag_j", "seeing_arcsec", "derotator_angle_deg"), **changes}
    (raw,) = read_recordings(path, instrument)
    return resolve(raw, AcquisitionKeys.model_validate(keys), instrument).acquisition


@pytest.mark.parametrize("layout", ["primary", "extension", "recorder"])
def test_the_pupil_turns_with_the_angles_of_the_header(tmp_path, turning, layout):
    if layout == "recorder":
        path = recorder(tmp_path, HEADER_OF_PARANAL)
    else:
        path = cube(tmp_path, HEADER_OF_PARANAL, extension=layout == "extension")
    acquisition = resolved(path, turning)
    assert acquisition.pupil_rotation_deg == pytest.approx((10 - 20 + 2 * 7) % 360)
    assert {key for key in FROM_HEADER if acquisition.sources[key] == HEADER} == FROM_HEADER
    assert (acquisition.mag_j, acquisition.altitude_deg, acquisition.pressure_hpa) == (10.5, 62.0, 744.0)


@pytest.mark.parametrize("told", [{"altitude_deg": 40.0}, {"airmass": 1.5557}])
def test_altitude_or_airmass_as_told_take_the_place_of_both_of_the_header(tmp_path, told):
    acquisition = resolved(cube(tmp_path, HEADER_OF_PARANAL), load_instrument("irlos"), **told)
    assert acquisition.altitude_deg == pytest.approx(40.0, abs=0.1)


def test_a_seeing_on_a_scale_that_the_profile_lacks_is_not_used(tmp_path):
    bench = load_instrument("bench")
    path = cube(tmp_path, HEADER_OF_PARANAL)
    assert resolved(path, bench).seeing_arcsec == bench.defaults["seeing_arcsec"]
    (raw,) = read_recordings(path, bench)
    assert any(
        "0.9 arcsec, is not used: the profile of bench has no seeing scale" in note for note in raw.notes
    )


def test_words_and_impossible_numbers_in_a_header_do_not_count(tmp_path, turning):
    header = HEADER_OF_PARANAL | {"ESO SEQ NGS MAG": "bright", "ESO TEL AMBI PRES START": -1.0}
    acquisition = resolved(cube(tmp_path, header), turning)
    assert acquisition.mag_j is None and acquisition.pressure_hpa == turning.defaults["pressure_hpa"]


def test_an_angle_that_the_rule_needs_has_to_be_known(tmp_path):
    instrument = turned_by(tmp_path, parallactic=-1)
    with pytest.raises(InputDataError, match="turns with 'parallactic_angle_deg', which is not known"):
        resolved(cube(tmp_path, {}), instrument)


def recording(name, angle_deg):
    return made(np.ones((1, 32, 32)), name, role="psf", diversity={}, pupil_rotation_deg=angle_deg)


def test_the_image_turns_with_the_pupil():
    instrument = load_instrument("irlos")
    images = [
        PsfModel(psf_settings(instrument, ModelConfig(), recording("a", angle)), (4,))
        .images(vector({}, (4,)))[0]
        .numpy()
        for angle in (0.0, 90.0)
    ]
    # both vanes lie on a diagonal: a quarter turn moves them to the other one
    assert np.abs(images[1] - np.rot90(images[0])).max() < 1e-5 * images[0].max()
    assert np.abs(images[1] - images[0]).max() > 1e-4 * images[0].max()


def test_recordings_with_pupils_at_different_angles_are_not_fitted_as_one():
    with pytest.raises(InputDataError, match="pupil_rotation_deg differ"):
        require_one_setup([recording("a", 0.0), recording("b", 5.0)])


@pytest.mark.parametrize(
    "cards",
    [
        {"DATE-OBS": STAMP},
        {"DATE-OBS": STAMP, "MJD-OBS": 50000.0},
        {"DATE-OBS": f"{STAMP}Z"},
        {"DATE-OBS": "2021-05-01T06:00:00+01:00"},
        {"DATE-OBS": "2021-04-30T22:30:00-06:30"},
        {"DATE-BEG": STAMP},
        {"MJD-OBS": MJD},
        {"DATE-OBS": "2021-05-01", "MJD-OBS": MJD},
        {"DATE-OBS": "2021-05-01", "UTC": "05:00:00"},
        {"DATE-OBS": "2021-05-01", "TIME-OBS": "05:00:00"},
        {"DATE-OBS": "01/05/21", "MJD-OBS": MJD},
    ],
)
def test_the_date_of_a_header_is_read_however_it_is_told(cards):
    assert start_of(fits.Header(cards)) == pytest.approx(UNIX_S, abs=1e-3)


@pytest.mark.parametrize(
    "cards",
    [
        {},
        {"DATE-OBS": ""},
        {"DATE-OBS": "2021-02-31T00:00:00"},
        {"DATE-OBS": "2021-02-31T00:00:00+01:00"},
        {"DATE-OBS": "yesterday"},
        {"MJD-OBS": 0.0},
        {"MJD-OBS": 1e300},
        {"MJD-OBS": "x"},
    ],
)
def test_what_is_no_date_is_no_date(cards):
    assert np.isnan(start_of(fits.Header(cards)))
