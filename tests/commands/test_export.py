"""Arrays copied out of a product into FITS and CSV."""

import json
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from astropy.time import Time
from astropy.wcs import WCS
from click.testing import Result
from conftest import invoke, without_report
from helpers.sparta_files import counts, star, write_muse

from irlos_pipe.product.product import Product, Quantity
from irlos_pipe.product.storage import write_product
from irlos_pipe.product.table import Card, fits_content, qc_keyword

pytestmark = pytest.mark.xdist_group("export")  # its fixtures serve all tests

RAW_HEADER = {
    "TELESCOP": "ESO-VLT-U4",
    "INSTRUME": "MUSE",
    "OBJECT": "HD 1",
    "DATE-OBS": "2024-02-11T03:05:20.123",
    "ESO OBS ID": 4711,
    "ESO TEL ALT": 71.4,
    "ESO INS DROT START": 112.7,
    "ESO AOS MAIN MODES IRLOS": "64x64_FullPupil_200Hz_HighGain",
}
SIDECAR = """\
role: ncpa_calibration
mag_j: 9.0
spectrum: [{wavelength_nm: 1600, weight: 1.0}]
diversity: {source: lens, zernike: {6: -170.0}}
"""
SMALL = """\
recipe: small
inputs: {cube: data}
stages: [ingest, calibrate, correct]
model: {pupil_samples: 48}
calibrate: {input: cube, method: lift_slices, highest_noll: 6, max_iterations: 3}
correct: {input: cube}
"""


@pytest.fixture
def product(tmp_path) -> Path:
    """A product with arrays of several kinds."""
    path = tmp_path / "03_calibrate.h5"
    ncpa = Quantity(np.array([1.5, -2.0]), "nm", "NCPA – Noll 2 and 3", error=np.array([0.1, 0.2]))
    arrays = {
        "zernike_nm": ncpa,
        "noll": Quantity(np.array([2, 3]), ""),
        "status": Quantity(np.array(["ok", ""]), ""),
        "sky/images_e": Quantity(np.arange(24.0).reshape(2, 3, 4), "e-"),
        "rms_nm": Quantity(np.asarray(3.5), "nm"),
        "good": Quantity(np.array([[True, False]]), ""),
    }
    write_product(Product("calibrate", arrays, {}), path)
    return path


def export(product: Path, output: Path, *names: str) -> Result:
    arrays = [part for name in names for part in ("--array", name)]
    return invoke("export", str(product), "--output", str(output), *arrays)


def rows(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if not line.startswith("#")]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["zernike_nm"], ["noll,zernike_nm [nm],zernike_nm_error [nm]", "2,1.5,0.1", "3,-2.0,0.2"]),
        (
            ["noll", "zernike_nm", "status"],
            ["noll,zernike_nm [nm],zernike_nm_error [nm],status", "2,1.5,0.1,ok", "3,-2.0,0.2,"],
        ),
    ],
)
def test_columns_of_equal_length_make_a_csv_table_with_units_errors_and_noll(
    product, tmp_path, names, expected
):
    assert export(product, tmp_path / "x.csv", *names).exit_code == 0
    assert rows(tmp_path / "x.csv") == expected


def test_arrays_go_into_fits_extensions_with_units_and_errors(product, tmp_path):
    names = ("sky/images_e", "zernike_nm", "status", "rms_nm", "good")
    assert export(product, tmp_path / "x.fits", *names).exit_code == 0
    with fits.open(tmp_path / "x.fits") as hdus:
        hdus.verify("exception")
        assert np.array_equal(hdus["SKY/IMAGES_E"].data, np.arange(24.0).reshape(2, 3, 4))
        assert hdus["SKY/IMAGES_E"].header["BUNIT"] == "e-"
        assert np.array_equal(hdus["ZERNIKE_NM_ERROR"].data, [0.1, 0.2])
        assert list(hdus["STATUS"].data["value"]) == ["ok", ""] and hdus["RMS_NM"].data["value"][0] == 3.5
        assert np.array_equal(hdus["GOOD"].data, [[1, 0]])


@pytest.mark.parametrize(
    ("file", "names", "message"),
    [
        ("x.csv", ["zernik_nm"], "did you mean 'zernike_nm'?"),
        ("x.csv", ["sky/images_e"], "use .fits"),
        ("x.csv", ["noll", "rms_nm"], "different lengths"),
        ("x.txt", ["noll"], "unknown file type"),
    ],
)
def test_an_impossible_export_is_reported_and_leaves_no_file(product, tmp_path, file, names, message):
    result = export(product, tmp_path / file, *names)
    assert result.exit_code == 2 and message in result.stderr and not (tmp_path / file).exists()


def test_an_export_replaces_a_file_only_when_forced(product, tmp_path):
    (tmp_path / "x.csv").write_text("precious")
    assert export(product, tmp_path / "x.csv", "noll").exit_code == 2
    assert (tmp_path / "x.csv").read_text() == "precious"
    result = invoke("export", str(product), "--array", "noll", "--output", str(tmp_path / "x.csv"), "--force")
    assert result.exit_code == 0 and (tmp_path / "x.csv").is_file()
    assert rows(tmp_path / "x.csv")[0] == "noll"


# -- headers: truth is the raw recording of the sample and the run's own files -------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """The correction from a small MUSE raw file."""
    folder = tmp_path_factory.mktemp("handed-on")
    adu = counts(star(32, 32), frames=8, pedestal_adu=200.0)
    write_muse(folder / "MUSE.fits", adu, header=RAW_HEADER).with_suffix(".yaml").write_text(SIDECAR)
    recipe = folder / "small.yaml"
    recipe.write_text(SMALL)
    with without_report():
        result = invoke(
            "run", str(recipe), "--input", f"cube={folder / 'MUSE.fits'}", "--output", str(folder / "run")
        )
    assert result.exit_code in (0, 4), result.stderr
    return folder / "run"


@pytest.mark.slow
def test_a_correction_has_the_header_of_the_raw_recording_and_passes_astropy(run):
    with fits.open(run / "correction.fits", checksum=True) as hdus:
        hdus.verify("exception")
        assert all(hdu.verify_checksum() == hdu.verify_datasum() == 1 for hdu in hdus)
        header = hdus[0].header
        assert {key: header[key] for key in RAW_HEADER} == RAW_HEADER
        assert header["MJD-OBS"] == pytest.approx(Time(RAW_HEADER["DATE-OBS"]).mjd, abs=1e-7)
        assert header["ESO PRO CATG"] == "IRLOS_MODAL_OFFSETS"
        assert header["ESO PRO REC1 RAW1 NAME"] == "MUSE.fits"
        assert header["ESO PRO REC1 RAW1 CATG"] == "NCPA_CALIBRATION"
        digits = sha256((run.parent / "MUSE.fits").read_bytes()).hexdigest()[:32]
        assert header["ESO PRO REC1 RAW1 SHA256"] == digits
        assert header["IRLOS DIVERSITY NOLL6"] == -170.0 and header["IRLOS PIXSCALE"] == 9.7
        assert header["IRLOS SIGN"] == "offset = -NCPA" and "irlos_pipe/" in header["ESO PRO REC1 PIPE ID"]


@pytest.mark.slow
def test_every_check_of_qc_json_stands_in_the_header_of_fits_and_csv(run):
    checks = json.loads((run / "qc.json").read_text())["checks"]
    header = fits.getheader(run / "correction.fits")
    lines = (run / "correction.csv").read_text().splitlines()
    assert header["ESO QC CHECKS"] == len(checks)
    failed = any(not check["passed"] for check in checks)
    assert lines[0].startswith("# QC FAILED, DO NOT APPLY") == failed == ("IRLOS VERDICT" in header)
    assert header["ESO QC FAILED"] == sum(not check["passed"] for check in checks)
    for check in checks:
        key = qc_keyword(check["name"])
        assert float(header[key]) == pytest.approx(check["value"], nan_ok=True)
        assert any(line.startswith(f"# {key} = ") for line in lines)


@pytest.mark.slow
def test_a_correction_is_read_as_a_table_with_units_from_both_files(run):
    table = QTable.read(run / "correction.fits")
    rows = np.genfromtxt(run / "correction.csv", delimiter=",", comments="#", skip_header=0)[1:]
    assert table["OFFSET"].unit == "nm" and list(table["NOLL"]) == list(range(2, 31))
    assert rows[:, 1] == pytest.approx(table["OFFSET"].value, abs=1e-4)


@pytest.mark.slow
def test_an_exported_image_knows_its_recording_and_where_its_pixels_lie(run):
    product, path = run / "02_calibrate.h5", run.parent / "x.fits"
    assert export(product, path, "mean_image_e").exit_code == 0
    with fits.open(path, checksum=True) as hdus:
        hdus.verify("exception")
        assert hdus[0].header["DATE-OBS"] == RAW_HEADER["DATE-OBS"]
        assert hdus[0].header["ESO PRO CATG"] == "IRLOS_CALIBRATE"
        centre = WCS(hdus[1].header).wcs_pix2world([[15.5, 15.5], [16.5, 15.5]], 0)
        assert hdus[1].header["CUNIT1"] == "mas"
        assert centre.ravel() == pytest.approx([0, 0, 9.7, 0])


def test_a_sentence_that_does_not_fit_goes_on_in_further_cards():
    notice = "simulated sample: 'calibration' and 'ramp' came with the package; no instrument was measured"
    header = fits.Header.fromstring(fits_content([], [Card("IRLOS NOTICE", notice)])[:2880].decode("ascii"))
    found = [value for key, value in header.items() if key.startswith("IRLOS NOTICE")]
    assert len(found) > 1 and " ".join(found) == notice


def test_text_that_does_not_fit_keeps_its_end_and_hostile_values_stay_in_their_card():
    cards = [
        Card("ESO PRO REC1 RAW1 NAME", "very/" * 30 + "end.fits", "file" * 40),
        Card("OBJECT", "it's\nEND", "χ² – µ"),
        Card("IRLOS LONG VALUE OF A NUMBER WITH MANY WORDS IN ITS KEY", 1.2345678901234567e-300),
        Card("NUMBER", 10**60),
    ]
    header = fits.Header.fromstring(fits_content([], cards)[:2880].decode("ascii"))
    assert header["ESO PRO REC1 RAW1 NAME"].endswith("very/end.fits")
    assert header["OBJECT"] == "it's?END" and header.comments["OBJECT"] == "chi2 - u"
    assert header["IRLOS LONG VALUE OF A NUMBER WITH MANY WORDS IN ITS KEY"] == pytest.approx(1.2345e-300)
    assert header["NUMBER"] == pytest.approx(1e60)
