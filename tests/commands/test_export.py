"""Arrays copied out of a product into FITS and CSV."""

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from click.testing import Result
from conftest import invoke

from irlos_pipe.product.product import Product, Quantity
from irlos_pipe.product.storage import write_product


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


def test_columns_of_equal_length_go_into_one_csv_table_with_units_and_errors(product, tmp_path):
    assert export(product, tmp_path / "x.csv", "noll", "zernike_nm", "status").exit_code == 0
    assert (tmp_path / "x.csv").read_text().splitlines() == [
        "noll,zernike_nm [nm],zernike_nm_error [nm],status",
        "2,1.5,0.1,ok",
        "3,-2.0,0.2,",
    ]


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
    assert result.exit_code == 0 and (tmp_path / "x.csv").read_text().startswith("noll\n")
