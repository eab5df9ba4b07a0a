"""The interface for Python programs: names, what they return, and how it shows itself."""

import ast

import numpy as np
import pytest
from helpers import made_run
from helpers.paths import PACKAGE, REPOSITORY

import irlos_pipe
from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.product.product import SPELLINGS, Product, Quantity
from irlos_pipe.stages import LIGHT_PATH, STAGES

SAMPLE = REPOSITORY / "data_samples" / "ramp" / "offset_00"


def product() -> Product:
    """Four modes with errors, five iterations, words and flags."""
    nm = np.array([1.0, -2.0, 3.0, 4.0])
    return Product(
        "calibrate",
        {
            "noll": Quantity(np.arange(2, 6), "", "Noll index"),
            "zernike_nm": Quantity(nm, "nm", "wavefront", error=nm**2),
            "status": Quantity(np.array(["fine"] * 4), "", "words"),
            "used": Quantity(np.ones(4, bool), "", "flags"),
            "iterations": Quantity(np.arange(5), "", "of every fit"),
            "image_e": Quantity(np.ones((3, 2)), "e-", "an image"),
        },
        {"wfe_nm": 5.0},
        provenance={"summary": ["NCPA  5 nm RMS"]},
    )


def test_the_stub_that_type_checkers_read_has_the_names_of_the_interface_at_their_homes():
    tree = ast.parse((PACKAGE / "__init__.pyi").read_text())
    stub = {
        node.names[0].name: node.module.removeprefix("irlos_pipe.")
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
    }
    assert stub == irlos_pipe.HOMES


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'calibrated'"):
        irlos_pipe.calibrated  # noqa: B018


def test_a_table_has_units_errors_and_descriptions():
    table = product().table()
    assert table.colnames == ["noll", "zernike_nm", "zernike_nm_error", "status", "used"]
    assert table["zernike_nm"][1].to_value("um") == pytest.approx(-2e-3)
    assert table["noll"].dtype == int and list(table["noll"]) == [2, 3, 4, 5]
    assert table["zernike_nm_error"].unit == "nm" and table["noll"].info.description == "Noll index"
    assert product().table("zernike_nm", "noll").colnames[0] == "zernike_nm"


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("nol",), "no array 'nol' in the product of 'calibrate'; did you mean 'noll'?"),
        (("noll", "iterations"), "different lengths do not fit into one table: noll 4, iterations 5"),
    ],
)
def test_arrays_that_make_no_table_are_refused(names, message):
    with pytest.raises(ConfigurationError) as error:
        product().table(*names)
    assert message in str(error.value)


def test_an_array_is_handed_on_as_data_with_uncertainty_and_unit():
    data = product()["zernike_nm"].nddata()
    assert data.unit == "nm" and data.uncertainty.array.tolist() == [1, 4, 9, 16]
    assert product()["image_e"].nddata().unit == "electron" and product()["used"].nddata().unit is None
    assert data.meta["description"] == "wavefront"


UNITS = {unit.removesuffix("±").strip() for name in LIGHT_PATH for unit, _, _ in STAGES[name].ARRAYS.values()}


@pytest.mark.parametrize("unit", sorted(UNITS))
def test_every_unit_of_a_product_stands_in_a_table(unit):
    quantity = Quantity(np.ones(2), unit, "")
    table = Product("calibrate", {"numbers": quantity}, {}).table()
    shown = SPELLINGS.get(unit, unit)
    assert table["numbers"].unit.to_string() == shown and quantity.nddata().unit.to_string() == shown


def test_a_run_is_its_products_its_results_and_its_checks(bench):
    done = irlos_pipe.run(irlos_pipe.load_recipe(bench.recipe), bench.output, last="calibrate")
    assert list(done) == ["ingest", "calibrate"] and done.results.status == "ok"
    assert repr(done).startswith(f"Run {bench.output}: recipe test, ok, ")
    again = irlos_pipe.open_run(bench.output)
    assert again["calibrate"].results == done["calibrate"].results
    assert again.checks == done["ingest"].checks + done["calibrate"].checks
    with pytest.raises(KeyError, match="no product of 'lift'"):
        again["lift"]


@pytest.mark.slow
def test_figures_are_those_of_the_report(tmp_path):
    folder = made_run.write_run(tmp_path, made_run.products("ingest", "calibrate"))
    found = irlos_pipe.open_run(folder).figures()
    assert found and all(figure.get_axes() for figure in found.values())
    assert list(found) == list(irlos_pipe.figures(folder))


def test_recordings_are_read_and_cleaned():
    (recording,) = irlos_pipe.read_recordings(SAMPLE, acquisition={"target": "a star"})
    assert recording.images_e.shape == (6, 64, 64) and recording.used.all()
    assert recording.acquisition.target == "a star" and np.ptp(recording.introduced_defocus_nm) == 0
