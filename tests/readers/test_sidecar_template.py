"""A proposed side-car holds every key, and can be read; values follow who writes the keywords."""

import numpy as np
import pytest
from astropy.io import fits
from conftest import invoke

from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.readers.sidecar import AcquisitionKeys, DetectorKeys, read_sidecar
from irlos_pipe.readers.sidecar_template import proposals, sidecar_template

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


ESO = {"HIERARCH ESO DET DIT": 0.2, "EXPTIME": 1.0}


@pytest.mark.parametrize(
    ("cards", "planes", "key", "value", "sure"),
    [
        ({"GAIN": 139, "EGAIN": 0.34}, 1, "detector.e_per_adu", 0.34, True),
        ({"GAIN": 139}, 1, "detector.e_per_adu", 139, False),
        ({"GAIN": (2.0, "[e-/ADU] gain")}, 1, "detector.e_per_adu", 2.0, True),
        ({"GAIN": (2.0, "electrons per DN")}, 1, "detector.e_per_adu", 2.0, True),
        ({"GAIN": (2.0, "[ADU/e-]")}, 1, "detector.e_per_adu", 2.0, False),
        ({"ITIME": 0.1, "COADDS": 20}, 1, "exposure_s", 2.0, True),
        ({"ITIME": 0.1, "COADDS": 20}, 1, "detector.read_s", 0.1, True),
        ({"EXPTIME": 2.0, "COADDEXP": 0.1, "COADDS": 20}, 1, "exposure_s", 2.0, True),
        ({"EXPTIME": 2.0, "COADDS": 20}, 1, "exposure_s", 2.0, True),
        (ESO | {"HIERARCH ESO DET NDIT": 5}, 5, "exposure_s", 0.2, True),
        (ESO | {"HIERARCH ESO DET NDIT": 4}, 5, "exposure_s", 0.2, True),
        (ESO | {"HIERARCH ESO DET NDIT": 5}, 1, "detector.coadds", 5, False),
        (ESO | {"HIERARCH ESO DET NDIT": 5}, 1, "exposure_s", 1.0, False),
    ],
)
def test_a_proposal_has_the_meaning_of_its_author_or_is_doubtful(cards, planes, key, value, sure):
    header = fits.Header()
    for name, content in cards.items():
        header[name] = content
    proposed = proposals(header, planes)[key]
    assert proposed.value == pytest.approx(value) and (proposed.doubt == "") is sure
