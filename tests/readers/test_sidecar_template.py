"""A side-car that is proposed for a recording holds every key, and what is proposed can be read."""

import numpy as np
import pytest
from astropy.io import fits
from conftest import invoke

from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.sidecar import AcquisitionKeys, DetectorKeys, read_sidecar
from irlos_pipe.readers.sidecar_template import sidecar_template

FILLED = {
    "role:": "role: psf",
    "spectrum:": "spectrum: [{wavelength_nm: 1600}]",
    "diversity:": "diversity: {source: none, zernike: {}}",
}


@pytest.fixture
def cube(tmp_path):
    path = tmp_path / "star.fits"
    header = fits.Header({"OBJECT": "HD 1", "EXPTIME": 0.5, "RDNOISE": -1.0})
    header["GAIN"] = (2.0, "[e-/ADU]")
    fits.PrimaryHDU(np.random.default_rng(0).poisson(50.0, (3, 16, 16)), header).writeto(path)
    return path


def test_the_template_is_valid_once_the_three_keys_are_filled_in(cube):
    text = sidecar_template(cube, load_instrument("irlos"))
    lines = [FILLED.get(line.partition(" ")[0], line) for line in text.splitlines()]
    cube.with_suffix(".yaml").write_text("\n".join(lines))
    keys = read_sidecar(cube.with_suffix(".yaml"))
    assert (keys.role, keys.target, keys.exposure_s) == ("psf", "HD 1", 0.5)
    assert keys.detector == DetectorKeys(e_per_adu=2.0)  # a read noise of -1 is none
    free = text.replace("# ", "")
    assert [
        key for key in [*AcquisitionKeys.model_fields, *DetectorKeys.model_fields] if key not in free
    ] == []


def test_the_airmass_of_a_header_is_proposed_unless_the_altitude_is_known(cube):
    said = fits.Header({"AIRMASS": 1.09, "FILTER": "FeII_1644", "SEEING": 0.9})
    fits.writeto(cube, fits.getdata(cube), said, overwrite=True)
    text = sidecar_template(cube, load_instrument("irlos"))
    assert "\nairmass: 1.09 " in text and "\nfilter: FeII_1644 " in text and "\nseeing_arcsec: 0.9 " in text
    fits.setval(cube, "EL", value=66.0)
    text = sidecar_template(cube, load_instrument("irlos"))
    assert "\naltitude_deg: 66.0 " in text and "\n# airmass: " in text


def test_the_command_writes_beside_the_file_and_replaces_nothing(cube):
    assert invoke("sidecar", str(cube)).stdout == f"{cube.with_suffix('.yaml')}\n"
    again = invoke("sidecar", str(cube))
    assert again.exit_code == 2 and "exists" in again.stderr
    assert invoke("sidecar", str(cube), "--output", "-").stdout == cube.with_suffix(".yaml").read_text()


def test_a_run_that_is_only_planned_and_a_validation_tell_all_that_side_cars_lack(cube, tmp_path):
    other = fits.getdata(cube)
    fits.writeto(tmp_path / "other.fits", other)
    (tmp_path / "other.yaml").write_text("rle: psf\nmag_j: 99\ndiversity: {zernike: {1: 3}}\n")
    invoke("sidecar", str(cube))
    options = ("diagnose", "--input", f"cube={tmp_path}")
    for result in (
        invoke("validate", *options),
        invoke("run", *options, "--output", str(tmp_path.parent / "out"), "--dry-run"),
    ):
        lines = result.stderr.splitlines()
        assert result.exit_code == 3 and len(lines) == 4
        assert [f"other.yaml:{number}:" in line for number, line in enumerate(lines[:3], 1)] == [True] * 3
        assert "star.yaml: keys 'role', 'spectrum', 'diversity' missing" in lines[3]
