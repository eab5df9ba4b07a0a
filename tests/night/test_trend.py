"""The numbers of all nights in the database, and `irlos trend`; truth is what was put in."""

import csv
import io
import json
import sqlite3
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from conftest import invoke
from helpers.stored_nights import DAY_S, measured, night, put

from irlos_pipe.night.database import NAME, opened
from irlos_pipe.night.page_sections import main_series, numbers_of_night, trend_section
from irlos_pipe.night.settings import BandSettings
from irlos_pipe.night.state import Night
from irlos_pipe.night.trend import make_trend, read_trend

JUMP_NM = 40.0


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
    trend = read_trend(tree, BandSettings())
    assert [one.name for one in trend.series] == ["noll_2_nm", "noll_4_nm", "noll_11_nm", "seeing_arcsec"]
    assert all(np.all(np.diff([point.unix_s for point in one.points]) == DAY_S) for one in trend.series)


def test_a_coefficient_out_of_its_band_alarms_and_the_seeing_does_not(tree):
    alarms = read_trend(tree, BandSettings()).alarms()
    assert [(point.night, point.name) for point, _ in alarms] == [
        (night(19), "wavefront_nm"),
        (night(19), "noll_4_nm"),
    ]


def test_the_trend_until_a_night_equals_the_trend_made_on_that_night(tree):
    rule = BandSettings()
    with opened(tree) as database:
        then = make_trend(database.points(night(12)), database.verdicts(night(12)), rule)
    late = read_trend(tree, rule).until(night(12))
    assert late.series == then.series and late.verdicts == then.verdicts and len(then.verdicts) == 13
    for one, other in zip(late.structures.values(), then.structures.values(), strict=True):
        assert np.array_equal(one.change_nm2, other.change_nm2)


def test_stability_is_the_structure_function_of_the_modes_without_tip_and_tilt(tree):
    """Against a sum over all pairs; 0.5 nm of noise in two modes is taken off."""
    trend = read_trend(tree, BandSettings(), until=night(18))
    (structure,) = trend.structures.values()
    modes = np.array(
        [
            [point.value for point in one.points]
            for one in trend.series
            if one.name in ("noll_4_nm", "noll_11_nm")
        ]
    )
    day_apart = np.mean(np.sum(np.diff(modes, axis=1) ** 2, axis=0)) - 4 * 0.5**2
    assert structure.lag_s[0] == DAY_S and structure.pairs[0] == 18
    assert structure.change_nm2[0] == pytest.approx(day_apart)
    assert structure.noise_nm2 == pytest.approx(np.full(len(structure.pairs), 1.0))


def test_two_recipes_make_two_series(tmp_path):
    for recipe in ("cube", "dip"):
        put(tmp_path, 0, measured(noll_4_nm=1.0), recipe=recipe)
    assert [one.recipe for one in read_trend(tmp_path, BandSettings()).series] == ["cube", "dip"]


def test_the_page_shows_every_verdict_of_the_night_with_the_gap_of_its_own_recording(tmp_path):
    for recipe, gap in (("cube", 0.02), ("muse", 0.05)):
        put(tmp_path, 0, measured(verdict="effect", gap_before=gap, gap_after=gap / 2), recipe=recipe)
    trend = read_trend(tmp_path, BandSettings())
    notes = [one.note for one in numbers_of_night(Night(night(0)), trend) if one.label.startswith("Missing")]
    assert [note.partition(": ")[2] for note in notes] == ["gap 0.020 → 0.010", "gap 0.050 → 0.025"]


def test_the_longest_of_several_series_is_shown_and_then_the_most_precise(tmp_path):
    put(tmp_path, 0, measured(noll_4_nm=1.0), recipe="one")
    for recipe in ("many", "few"):
        put(tmp_path, 1, measured(noll_4_nm=2.0), recipe=recipe)
    put(tmp_path, 2, measured(noll_4_nm=2.0), recipe="many")
    trend = read_trend(tmp_path, BandSettings())
    assert main_series(trend, "noll_4_nm").recipe == "many"
    assert main_series(trend.until(night(0)), "noll_4_nm").recipe == "one"


# -- the command -------------------------------------------------------------------------------


def test_the_table_shows_what_alarms_the_stability_and_counts_the_rest(tree):
    result = invoke("trend", str(tree))
    assert result.exit_code == 4
    rows = {line.split()[0]: line.split() for line in result.stdout.splitlines() if line}
    assert rows["noll_4_nm"][-1] == "ALARM" and "noll_11_nm" not in rows
    assert rows["cube,"][1:4] == ["last", "night", night(19)]
    assert "2 of 3 modes are as expected" in result.stdout and "all modes: 39." in result.stdout
    assert "lag [days]" in result.stdout and "verdict" in result.stdout
    line = "irlos: error: 2 numbers out of band: 2024-02-29/030000_cube/cube: wavefront_nm = "
    assert result.stderr.startswith(line)
    assert "noll_11_nm" in invoke("trend", str(tree), "--all").stdout


def test_many_modes_fit_a_terminal(tmp_path):
    rng = np.random.default_rng(1)
    for day in range(12):
        modes = {f"noll_{noll}_nm": rng.normal(0, 0.5) for noll in range(2, 31)}
        put(tmp_path, day, measured(verdict="none", ncpa_nm=50.0, seeing_arcsec=0.6, **modes))
    lines = invoke("trend", str(tmp_path)).stdout.splitlines()
    assert len(lines) <= 24 and max(map(len, lines)) <= 80


def test_csv_holds_every_point(tree):
    rows = list(csv.DictReader(io.StringIO(invoke("trend", str(tree), "--csv").stdout)))
    assert len(rows) == 20 * 4
    assert [(row["night"], row["name"]) for row in rows if row["alarm"] == "1"] == [(night(19), "noll_4_nm")]


def test_a_night_within_its_bands_is_exit_code_0_and_silent_on_stderr(tree):
    result = invoke("trend", str(tree), "--until", night(18))
    assert (result.exit_code, result.stderr) == (0, "") and night(19) not in result.stdout


def test_json_holds_every_point_with_its_band(tree):
    content = json.loads(invoke("trend", str(tree), "--json").stdout)
    series = {one["name"]: one["points"] for one in content["series"]}
    low, high = series["noll_4_nm"][-1]["band"]
    assert low < 40 < high < series["noll_4_nm"][-1]["value"] and series["noll_4_nm"][0]["band"] is None
    assert (
        len(content["verdicts"]) == 20
        and content["stability"][0]["pairs"][0] == 19
        and len(content["alarms"]) == 2
    )


@pytest.mark.slow
@pytest.mark.parametrize(("ending", "begin"), [("svg", b"<?xml"), ("png", b"\x89PNG")])
def test_a_plot_is_drawn_to_a_file(tree, ending, begin):
    path = tree / f"focus.{ending}"
    assert invoke("trend", str(tree), "--of", "noll_4_nm", "--plot", str(path)).exit_code == 4
    assert path.read_bytes().startswith(begin)


@pytest.mark.parametrize(
    ("options", "code", "line"),
    [
        (("--of", "noll_5_nm"), 2, "--of noll_5_nm: no such number; did you mean 'noll_4_nm'?"),
        (("--plot", "x.gif"), 2, "--plot x.gif: give a name that ends in .svg, .png, .pdf"),
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


@pytest.mark.slow
def test_a_dollar_in_a_name_is_no_formula(tree):
    run = put(tree, 20, measured(noll_4_nm=1.0), recipe="a$b_{$")
    assert "$" in run
    with sqlite3.connect(tree / NAME) as connection:
        connection.execute("UPDATE runs SET configuration = 'diversity $x_{$'")
    result = invoke("trend", str(tree), "--plot", str(tree / "focus.svg"))
    assert (tree / "focus.svg").is_file() and "unexpected" not in result.stderr


def test_the_page_of_one_night_lists_numbers_and_that_of_many_says_how_long_a_calibration_is_valid(tree):
    rule, last = BandSettings(), night(18)
    first = trend_section(read_trend(tree, rule, until=night(0)))
    assert [block.kind for block in first.blocks] == ["table"] and len(first.blocks[0].rows) == 4
    put(tree, 18, measured(noll_4_nm=40.0, noll_2_nm=20.0, noll_11_nm=110.0, ncpa_nm=50.0))
    tile = next(
        one
        for one in numbers_of_night(Night(last), read_trend(tree, rule, until=last))
        if one.label == "Calibration valid for"
    )
    assert tile.value.endswith(" days") and "20 nm RMS" in tile.note
