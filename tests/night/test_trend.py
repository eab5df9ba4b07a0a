"""The numbers of all nights in the database, `irlos trend`, the dashboard; truth is what was put in."""

import csv
import io
import json
import math
import sqlite3
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from conftest import invoke
from helpers.stored_nights import DAY_S, measured, night, put

from irlos_pipe.night.database import NAME, opened
from irlos_pipe.night.page import main_series, numbers_of_night
from irlos_pipe.night.settings import BandSettings
from irlos_pipe.night.state import Night
from irlos_pipe.night.trend import make_trend, read_trend
from irlos_pipe.product.product import Check
from irlos_pipe.reference import COMMANDS

JUMP_NM = 40.0
RULE = BandSettings()


@pytest.fixture
def tree(tmp_path) -> Path:
    """Twenty nights of three modes with 0.5 nm of noise; in the last, Noll 4 is 40 nm off."""
    rng = np.random.default_rng(0)
    for day in range(20):
        modes = {f"noll_{noll}_nm": 10.0 * noll + rng.normal(0, 0.5) for noll in (2, 4, 11)}
        modes["noll_4_nm"] += JUMP_NM * (day == 19)
        put(tmp_path, day, measured(verdict="none", seeing_arcsec=0.5 + 3 * (day == 19), **modes))
    return tmp_path


def test_a_run_that_is_stored_again_replaces_its_numbers(tmp_path):
    run = put(tmp_path, 0, measured("old", noll_4_nm=1.0, noll_5_nm=2.0))
    put(tmp_path, 0, measured("new", noll_4_nm=3.0))
    with opened(tmp_path) as database:
        assert [(one.name, one.value) for one in database.points()] == [("noll_4_nm", 3.0)]
        assert database.run_key(run) == "new" and database.run_key("other") == ""


def test_a_run_without_a_time_is_placed_at_midnight_of_its_night(tmp_path):
    put(tmp_path, 0, measured(noll_4_nm=1.0), start=False)
    with opened(tmp_path) as database:
        (point,) = database.points()
    assert datetime.fromtimestamp(point.unix_s, UTC).isoformat() == "2024-02-11T04:42:00+00:00"


def test_numbers_come_in_order_of_time_with_modes_in_order_of_their_index(tree):
    trend = read_trend(tree, RULE)
    assert [one.name for one in trend.series] == ["noll_2_nm", "noll_4_nm", "noll_11_nm", "seeing_arcsec"]
    assert all(np.all(np.diff([point.unix_s for point in one.points]) == DAY_S) for one in trend.series)


def test_the_trend_until_a_night_equals_the_trend_made_on_that_night(tree):
    with opened(tree) as database:
        found = (database.points(), database.verdicts())
    then = make_trend(*([one for one in some if one.night <= night(12)] for some in found), RULE)
    late = read_trend(tree, RULE).until(night(12))
    assert late == then and len(then.verdicts) == 13
    ((one, _),), ((other, _),) = late.stabilities.values(), then.stabilities.values()
    assert np.array_equal(one.change_nm2, other.change_nm2)


def test_stability_is_the_structure_function_of_the_modes_without_tip_and_tilt(tree):
    """Against a sum over all pairs; 0.5 nm of noise in two modes is taken off."""
    trend = read_trend(tree, RULE, until=night(18))
    ((structure, _),) = trend.stabilities.values()
    wanted = [one for one in trend.series if one.name in ("noll_4_nm", "noll_11_nm")]
    modes = np.array([[point.value for point in one.points] for one in wanted])
    day_apart = np.mean(np.sum(np.diff(modes, axis=1) ** 2, axis=0)) - 4 * 0.5**2
    assert structure.lag_s[0] == DAY_S and structure.pairs[0] == 18
    assert structure.change_nm2[0] == pytest.approx(day_apart)
    assert structure.noise_nm2 == pytest.approx(np.full(len(structure.pairs), 1.0))


def test_of_several_recipes_the_page_shows_the_longest_series_and_each_verdict_with_its_own_gap(tmp_path):
    put(tmp_path, 0, measured(noll_4_nm=1.0), recipe="one")
    for recipe, gap in (("many", 0.02), ("few", 0.05)):
        numbers = {"noll_4_nm": 2.0, "gap_before": gap, "gap_after": gap / 2}
        put(tmp_path, 1, measured(verdict="effect", **numbers), recipe=recipe)
    put(tmp_path, 2, measured(noll_4_nm=2.0), recipe="many")
    trend = read_trend(tmp_path, RULE)
    assert main_series(trend, "noll_4_nm").owner[0] == "many"
    assert main_series(trend.until(night(0)), "noll_4_nm").owner[0] == "one"
    notes = [one.note for one in numbers_of_night(Night(night(1)), trend) if one.label.startswith("Missing")]
    assert sorted(note.partition(": ")[2] for note in notes) == ["gap 0.020 → 0.010", "gap 0.050 → 0.025"]


# -- the command -------------------------------------------------------------------------------


def test_the_table_shows_what_alarms_the_stability_and_counts_the_rest(tree):
    result = invoke("trend", str(tree))
    assert result.exit_code == 4
    rows = {line.split()[0]: line.split() for line in result.stdout.splitlines() if line}
    assert rows["noll_4_nm"][-1] == "ALARM" and "noll_11_nm" not in rows
    assert rows["cube,"][1:4] == ["last", "night", night(19)]
    assert "2 of 3 modes are as expected" in result.stdout and "all modes: 39." in result.stdout
    first = invoke("trend", str(tree), "--until", night(0)).stdout
    assert "3 of 3 modes have too few nights" in first and "as expected" not in first
    assert "lag [days]" in result.stdout and "verdict" in result.stdout
    line = "irlos: error: 2 numbers out of band: 2024-02-29/030000_cube/cube: wavefront_nm = "
    assert result.stderr.startswith(line)
    assert "noll_11_nm" in invoke("trend", str(tree), "--all").stdout


def test_csv_and_json_hold_every_point_with_its_band(tree):
    rows = list(csv.DictReader(io.StringIO(invoke("trend", str(tree), "--csv").stdout)))
    assert len(rows) == 20 * 4
    assert [(row["night"], row["name"]) for row in rows if row["alarm"] == "1"] == [(night(19), "noll_4_nm")]
    content = json.loads(invoke("trend", str(tree), "--json").stdout)
    jsonschema.validate(content, json.loads(COMMANDS.read_text()))
    points = {one["name"]: one["points"] for one in content["series"]}["noll_4_nm"]
    low, high = points[-1]["band"]
    assert low < 40 < high < points[-1]["value"] and points[0]["band"] is None
    assert content["stability"][0]["pairs"][0] == 19
    assert (len(content["verdicts"]), len(content["alarms"])) == (20, 2)


def test_a_night_within_its_bands_is_exit_code_0_and_silent_on_stderr(tree):
    result = invoke("trend", str(tree), "--until", night(18))
    assert (result.exit_code, result.stderr) == (0, "") and night(19) not in result.stdout


@pytest.mark.slow
def test_a_plot_is_drawn_to_a_file_and_a_dollar_in_a_name_is_no_formula(tree):
    assert invoke("trend", str(tree), "--of", "noll_4_nm", "--plot", str(tree / "a.png")).exit_code == 4
    assert (tree / "a.png").read_bytes().startswith(b"\x89PNG")
    put(tree, 20, measured(noll_4_nm=1.0), recipe="a$b_{$")
    with sqlite3.connect(tree / NAME) as connection:
        connection.execute("UPDATE runs SET configuration = 'diversity $x_{$'")
    result = invoke("trend", str(tree), "--plot", str(tree / "a.svg"))
    assert (tree / "a.svg").read_bytes().startswith(b"<?xml") and "unexpected" not in result.stderr


@pytest.mark.parametrize(
    ("options", "code", "line"),
    [
        (("--of", "noll_5_nm"), 2, "--of noll_5_nm: no such number; did you mean 'noll_4_nm'?"),
        (("--plot", "x.gif"), 2, "--plot x.gif: give a name that ends in .svg, .png, .pdf"),
        (("--dashboard", "x.txt"), 2, "--dashboard x.txt: give a name that ends in .json"),
        (("--until", "2023-01-01"), 64, "no numbers yet until 2023-01-01"),
    ],
)
def test_a_mistake_is_reported_in_one_line(tree, options, code, line):
    result = invoke("trend", str(tree), *options)
    assert result.exit_code == code and line in result.stderr and result.stderr.count("\n") == 1


def test_a_folder_that_is_no_tree_is_bad_data(tmp_path):
    result = invoke("trend", str(tmp_path))
    assert result.exit_code == 3 and "make one with: irlos night" in result.stderr
    assert not (tmp_path / NAME).exists()


def test_a_database_that_is_damaged_is_reported_with_what_to_do(tmp_path):
    (tmp_path / NAME).write_bytes(b"no database" * 100)
    result = invoke("trend", str(tmp_path))
    assert result.exit_code == 1 and "move the file away" in result.stderr and result.stderr.count("\n") == 1


def test_a_database_of_a_newer_version_is_not_touched(tree):
    with sqlite3.connect(tree / NAME) as connection:
        connection.execute("PRAGMA user_version = 99")
    before = (tree / NAME).read_bytes()
    result = invoke("trend", str(tree))
    assert result.exit_code == 1 and "written by a newer irlos_pipe" in result.stderr
    assert result.stderr.count("\n") == 1 and (tree / NAME).read_bytes() == before


def test_a_database_of_the_first_version_is_read_again_from_the_products(tmp_path):
    run = put(tmp_path, 0, measured("k", noll_4_nm=1.0))
    with sqlite3.connect(tmp_path / NAME) as connection:
        connection.execute("DROP TABLE checks")
        connection.execute("PRAGMA user_version = 1")
    with opened(tmp_path) as database:
        assert database.run_key(run) == "" and len(database.points()) == 1


def test_the_queries_of_the_dashboard_find_what_was_put_in(tmp_path):
    checks = [
        ("calibrate", Check("chi2", 3.0, "", None, 2.0, "too large")),
        ("correct", Check("gain", math.nan, "nm", 0.0, None, "not known")),
        ("ingest", Check("frames", 1.0, "1", 0.5, 2.0, "fine")),
    ]
    content = measured(verdict="effect", noll_4_nm=10.0, ncpa_nm=50.0, ramp_slope=1.0)
    put(tmp_path, 0, replace(content, effects=["ghost"], checks=checks))
    path, found = tmp_path / "irlos.json", {}
    assert invoke("trend", str(tmp_path), "--dashboard", str(path)).exit_code == 0
    with sqlite3.connect(tmp_path / NAME) as connection:
        rows = connection.execute("SELECT name, value, low, high, passed FROM checks").fetchall()
        for panel in json.loads(path.read_text())["panels"]:
            query = panel["targets"][0]["queryText"]
            query = query.replace("$__from", "1707000000000").replace("$__to", "1708000000000")
            found[panel["title"]] = connection.execute(query).fetchall()
    kept = [("chi2", 3.0, None, 2.0, 0), ("gain", None, 0.0, None, 0), ("frames", 1.0, 0.5, 2.0, 1)]
    assert rows == kept
    assert found["NCPAs, Noll 4 to 11"] == [(1707620400, "noll_4_nm cube", 10.0)]
    assert [row[2] for row in found["Checks that failed"]] == ["chi2", "gain"]
    assert found["What the model lacks"][0][3:] == ("effect", '["ghost"]')
    assert found["RMS of the NCPAs"] and found["Slope of ramps"] and len(found["Runs"]) == 1
