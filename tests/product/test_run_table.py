"""Checks and numbers of a run as a table; truth is qc.json and results.json."""

import csv
import json
import sqlite3

import pytest
from conftest import invoke
from helpers import made_run

from irlos_pipe.product.product import Check


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


def test_a_folder_that_is_no_run_is_bad_data(tmp_path):
    assert invoke("export", str(tmp_path), "--output", str(tmp_path / "x.csv")).exit_code == 3
