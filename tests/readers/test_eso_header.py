"""Keywords of an ESO header in files of any layout."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from astropy.io import fits
from helpers.sparta_files import counts, sidecar, star, write_recorder

from irlos_pipe.frames.recording import HEADER, SIDECAR
from irlos_pipe.instrument.instrument import PROFILES, load_instrument
from irlos_pipe.readers.acquisition import resolve
from irlos_pipe.readers.find import read_recordings
from irlos_pipe.readers.sidecar import AcquisitionKeys

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


@pytest.fixture
def turning(tmp_path):
    """IRLOS whose pupil turns with both angles."""
    profile = yaml.safe_load((PROFILES / "irlos.yaml").read_text())
    rule = {"offset_deg": 10, "parallactic": -1, "derotator": 2}
    profile["pupil"] = {"source": "a test", "status": "assumed", "turns": rule}
    path = tmp_path / "turning.yaml"
    path.write_text(yaml.safe_dump(profile))
    return load_instrument(path)


def cube(folder, header, *, extension=False):
    """A plain cube, in the primary HDU or behind it."""
    primary = fits.PrimaryHDU(None if extension else np.ones((2, 16, 16), np.float32))
    primary.header.update({f"HIERARCH {key}": value for key, value in header.items()})
    hdus = [primary, *([fits.ImageHDU(np.ones((2, 16, 16), np.float32))] if extension else [])]
    fits.HDUList(hdus).writeto(folder / "cube.fits")
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


def test_what_a_person_says_counts_before_the_header(tmp_path, turning):
    path = cube(tmp_path, HEADER_OF_PARANAL)
    path.with_suffix(".yaml").write_text(yaml.safe_dump({"parallactic_angle_deg": 50.0}))
    acquisition = resolved(path, turning)
    assert acquisition.pupil_rotation_deg == pytest.approx((10 - 50 + 2 * 7) % 360)
    assert acquisition.sources["parallactic_angle_deg"] == SIDECAR


@pytest.mark.parametrize("told", [{"altitude_deg": 40.0}, {"airmass": 1.5557}])
def test_altitude_or_airmass_as_told_take_the_place_of_both_of_the_header(tmp_path, told):
    acquisition = resolved(cube(tmp_path, HEADER_OF_PARANAL), load_instrument("irlos"), **told)
    assert acquisition.altitude_deg == pytest.approx(40.0, abs=0.1)


def test_the_seeing_of_the_header_is_that_of_the_monitor(tmp_path):
    """0.8 of it on the scale of SPARTA, by the profile of IRLOS."""
    acquisition = resolved(cube(tmp_path, HEADER_OF_PARANAL), load_instrument("irlos"))
    assert acquisition.seeing_arcsec == pytest.approx(0.72)


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
