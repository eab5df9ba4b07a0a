"""The dashboard and the table of checks; truth is what was put into the database."""

import json
import math
import sqlite3

import pytest
from conftest import invoke
from helpers.stored_nights import measured, put

from irlos_pipe.night.database import NAME, opened
from irlos_pipe.night.measurements import Measurements
from irlos_pipe.product.product import Check

CHECKS = [
    ("calibrate", Check("chi2", 3.0, "", None, 2.0, "too large")),
    ("correct", Check("gain", math.nan, "nm", 0.0, None, "not known")),
    ("ingest", Check("frames", 1.0, "1", 0.5, 2.0, "fine")),
]


@pytest.fixture
def tree(tmp_path):
    numbers = {"noll_4_nm": (10.0, 0.5), "ncpa_nm": (50.0, None), "ramp_slope": (1.0, 0.1)}
    put(tmp_path, 0, Measurements("ok", numbers, [], "effect", ["ghost"], "irlos_pipe 1", "k", CHECKS))
    return tmp_path


def test_all_checks_of_a_run_are_in_the_database_with_their_limits(tree):
    with sqlite3.connect(tree / NAME) as connection:
        rows = connection.execute(
            "SELECT name, value, low, high, passed FROM checks ORDER BY name"
        ).fetchall()
    assert rows == [
        ("chi2", 3.0, None, 2.0, 0),
        ("frames", 1.0, 0.5, 2.0, 1),
        ("gain", None, 0.0, None, 0),
    ]


def test_the_queries_of_the_dashboard_find_what_was_put_in(tree):
    path = tree / "irlos.json"
    assert invoke("trend", str(tree), "--dashboard", str(path)).exit_code == 0
    found = {}
    with sqlite3.connect(tree / NAME) as connection:
        for panel in json.loads(path.read_text())["panels"]:
            query = panel["targets"][0]["queryText"]
            query = query.replace("$__from", "1707000000000").replace("$__to", "1708000000000")
            found[panel["title"]] = connection.execute(query).fetchall()
    assert found["NCPAs, Noll 4 to 11"] == [(1707620400, "noll_4_nm cube", 10.0)]
    assert [row[2] for row in found["Checks that failed"]] == ["chi2", "gain"]
    assert found["What the model lacks"][0][3:] == ("effect", '["ghost"]')
    assert found["RMS of the NCPAs"] and found["Slope of ramps"] and len(found["Runs"]) == 1


def test_a_database_of_the_first_version_is_read_again_from_the_products(tmp_path):
    run = put(tmp_path, 0, measured("k", noll_4_nm=1.0))
    with sqlite3.connect(tmp_path / NAME) as connection:
        connection.execute("DROP TABLE checks")
        connection.execute("PRAGMA user_version = 1")
    with opened(tmp_path) as database:
        assert database.run_key(run) == "" and len(database.points()) == 1


def test_a_dashboard_of_another_name_is_a_mistake(tree):
    assert invoke("trend", str(tree), "--dashboard", str(tree / "x.txt")).exit_code == 2
