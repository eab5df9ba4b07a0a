"""Two runs side by side; truth: what the made-up runs differ in."""

import csv
import json
import math
import os
import shutil
import sqlite3
import sys
from pathlib import Path

import pytest
from conftest import invoke
from helpers import made_run

from irlos_pipe.product.printed import Comparison, NumberPair
from irlos_pipe.product.product import Check, Product
from irlos_pipe.product.run_table import compare_runs, leaves
from irlos_pipe.product.runfolder import RunFolder, is_standing


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


# Checks and numbers of a run as a table; truth is qc.json and results.json.


@pytest.fixture
def folder(tmp_path):
    made = made_run.products("ingest", "calibrate")
    made[1].checks.append(Check("chi2, of the mean", 3.5, "", None, 2.0, "too large; look"))
    folder = made_run.write_run(tmp_path / "run", made)
    checks = [{"stage": one.stage, **check.as_dict()} for one in made for check in one.checks]
    (folder / "qc.json").write_text(json.dumps({"checks": checks}))
    return folder


def test_csv_and_sqlite_hold_every_check_and_every_number(folder, tmp_path):
    for name in ("t.csv", "t.sqlite"):
        result = invoke("export", str(folder), "--output", str(tmp_path / name))
        assert result.exit_code == 0, result.stderr
    rows = list(csv.DictReader((tmp_path / "t.csv").open()))
    checks = json.loads((folder / "qc.json").read_text())["checks"]
    assert [row["name"] for row in rows if row["kind"] == "check"] == [check["name"] for check in checks]
    assert next(row for row in rows if row["message"] == "too large; look")["passed"] == "0"
    numbers = {(row["stage"], row["name"]): (float(row["value"]), row["unit"]) for row in rows
               if row["kind"] == "number"}  # fmt: skip
    assert numbers["calibrate", "zernike_nm.4"] == (made_run.NCPA_NM["4"], "nm")
    assert numbers["ingest", "inputs.0.frames"][0] > 0
    with sqlite3.connect(tmp_path / "t.sqlite") as connection:
        assert connection.execute("SELECT count(*) FROM checks").fetchone()[0] == len(checks)
        assert connection.execute("SELECT count(*) FROM numbers").fetchone()[0] == len(numbers)
        query = "SELECT name, high FROM checks WHERE NOT passed"
        assert connection.execute(query).fetchall()[-1] == ("chi2, of the mean", 2.0)


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (("--output", "x.txt"), 2, "use .csv or .sqlite"),
        (("--array", "noll", "--output", "x.csv"), 2, "is a folder"),
    ],
)
def test_mistakes_are_reported(folder, options, code, message):
    result = invoke("export", str(folder), *options)
    assert result.exit_code == code and message in result.stderr


# The stamp of a run holds as long as nothing is touched that its products depend on.


@pytest.fixture
def run(bench) -> RunFolder:
    bench.run()
    run = RunFolder(bench.output)
    assert is_standing(run)
    return run


def later(path) -> None:
    os.utime(path, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns + 1))


def test_a_status_without_changes_does_not_make_a_plan(bench, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "irlos_pipe.pipeline.plan", None)  # importing it fails
    lines = invoke("status", str(bench.output)).stdout.splitlines()
    assert [line.split()[0] for line in lines[1:]] == ["01_ingest.h5", "02_calibrate.h5", "03_lift.h5"]
    assert all("up to date" in line for line in lines[1:])


@pytest.mark.parametrize(
    "change",
    [
        lambda bench: later(bench.data / "a.dat"),
        lambda bench: (bench.data / "c.dat").write_bytes(b"1"),
        lambda bench: (bench.data / "b.dat").unlink(),
        lambda bench: later(bench.output / "recipe.resolved.yaml"),
        lambda bench: (bench.output / "02_calibrate.h5").unlink(),
        lambda bench: later(bench.output / "03_lift.h5"),
        lambda bench: shutil.move(bench.data, bench.folder / "elsewhere"),
    ],
)
def test_whatever_is_touched_breaks_the_stamp(bench, run, change):
    change(bench)
    assert not is_standing(run)


def test_a_run_of_a_part_and_a_link_to_a_folder_leave_no_stamp(bench):
    bench.run("--to", "calibrate")
    assert not is_standing(RunFolder(bench.output))
    (bench.folder / "other").mkdir()
    (bench.data / "link").symlink_to(bench.folder / "other")
    bench.run()
    assert not is_standing(RunFolder(bench.output))


def test_the_command_prints_the_most_significant_first_and_all_on_demand(pair):
    short = invoke("compare", *map(str, pair)).stdout
    lines = [line for line in short.splitlines() if line.split()[-1:] == ["σ"]]
    sigmas = [abs(float(line.split()[-2])) for line in lines if line.split()[-2][0] in "+-"]
    assert sigmas == sorted(sigmas, reverse=True) and sigmas[0] == 1.4  # 4 over sqrt(8)
    assert "seed  0 → 1" in short and "passed → failed" in short
    assert len(invoke("compare", *map(str, pair), "--all").stdout) >= len(short)
