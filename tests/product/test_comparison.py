"""Two runs side by side; truth: what the made-up runs differ in."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from helpers import made_run

from irlos_pipe.product.printed import Comparison, NumberPair
from irlos_pipe.product.product import Product
from irlos_pipe.product.run_table import compare_runs, leaves


def write(folder: Path, made: list[Product], **recipe: object) -> Path:
    """A run with the quality control that its products state, and further keys of the recipe."""
    made_run.write_run(folder, made)
    checks = [{"stage": one.stage, **check.as_dict()} for one in made for check in one.checks]
    (folder / "qc.json").write_text(json.dumps({"checks": checks}))
    with open(folder / "recipe.resolved.yaml", "a") as stream:
        stream.write(json.dumps(recipe)[1:-1].replace('"', "") + "\n" if recipe else "")
    return folder


@pytest.fixture
def pair(tmp_path) -> tuple[Path, Path]:
    """Runs that differ in modes, in the method, and in a check that fails."""
    first = write(tmp_path / "a", made_run.products("ingest", "calibrate", "lift"), seed=0)
    ingest, calibrate, lift = made_run.products("ingest", "calibrate", "lift")
    names = list(calibrate.results["zernike_nm"])[:3]
    moved = {
        name: calibrate.results["zernike_nm"][name] + step
        for name, step in zip(names, (3, 0, -4), strict=True)
    }
    calibrate.results["zernike_nm"] = calibrate.results["zernike_nm"] | moved
    calibrate.results["method"] = "dip_global"
    lift.results["untested"] = ["the sign"]
    check = calibrate.checks[0]
    calibrate.checks[0] = type(check)(check.name, 0.5, check.unit, check.low, check.high, check.message)
    second = write(tmp_path / "b", [ingest, calibrate, lift], seed=1)
    return first, second


def number(found: Comparison, name: str) -> NumberPair:
    (one,) = [one for one in found.numbers if f"{one.stage}.{one.name}" == name]
    return one


def test_a_run_is_the_same_as_itself(pair):
    found = compare_runs(pair[0], pair[0])
    assert {one.difference for one in found.numbers} == {0.0} and found.same_files
    assert not (found.settings or found.words or found.checks or found.only_first or found.only_second)


def test_differences_are_the_second_less_the_first_in_units_of_both_errors(pair):
    """Errors of 2 nm in both: sqrt(8) together; 3 and -4 nm make 5 nm RMS of wavefront."""
    found = compare_runs(*pair)
    first = number(found, f"calibrate.zernike_nm.{made_run.NOLLS[0]}")
    assert first.difference == pytest.approx(3.0) and first.unit == "nm"
    assert first.sigmas == pytest.approx(3.0 / math.sqrt(8.0))
    modes = next(one for one in found.modes if one.name == "zernike_nm")
    assert modes.difference_nm == pytest.approx(5.0)
    assert modes.expected_nm == pytest.approx(math.sqrt(8.0 * modes.modes))


def test_what_was_asked_for_and_what_was_concluded_stand_beside_the_numbers(pair):
    found = compare_runs(*pair)
    assert [(one.name, one.first, one.second) for one in found.settings] == [("seed", 0, 1)]
    assert ("calibrate.method", "long_exposure", "dip_global") in [
        (one.name, one.first, one.second) for one in found.words
    ]
    assert [(one.name, one.first, one.second) for one in found.checks] == [
        ("calibrate: twin solution", "passed", "failed")
    ]
    assert found.only_first == [] and found.only_second == ["lift.untested"]


@pytest.mark.parametrize(
    ("tree", "path", "error"),
    [
        ({"zernike_nm": {"4": 1.0}, "sigma_nm": {"4": 0.2}}, ("zernike_nm", "4"), 0.2),
        ({"defocus_nm": 1.0, "sigma_nm": 0.3}, ("defocus_nm",), 0.3),
        ({"slope": 1.0, "slope_sigma": 0.1}, ("slope",), 0.1),
        ({"wfe_nm": 1.0, "wfe_sigma_nm": 0.4}, ("wfe_nm",), 0.4),
        ({"pedestal_adu": 1.0, "pedestal_error_adu": 0.5}, ("pedestal_adu",), 0.5),
        ({"effects": {"a": {"x": 1.0}}, "effects_sigma": {"a": {"x": 0.6}}}, ("effects", "a", "x"), 0.6),
        ({"parameters": {"p": [1.0, 2.0]}, "sigma": {"p": [0.1, 0.7]}}, ("parameters", "p", "1"), 0.7),
    ],
)
def test_the_error_of_a_number_is_found_and_is_no_number_of_its_own(tree, path, error):
    found = {name: leaf for name, leaf in leaves(tree) if not math.isnan(leaf.error)}
    assert found[path].error == error and not any("sigma" in key or "error" in key for key in map(str, found))
