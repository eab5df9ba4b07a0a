"""Nights with odd names, links, pipes, spoiled databases: what can be reduced is, the rest is named."""

import os
import sqlite3

import pytest
from fuzz.tree_kinds import ROWS
from helpers.night_bench import night_bench  # noqa: F401 - the fixture `bench`

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError, Locked
from irlos_pipe.night import database
from irlos_pipe.night.reduce import PublishedRun, Task, failure
from irlos_pipe.night.settings import load_settings

MORNING = "2024-02-11T03:00:00"


# -- names --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_longest_names_are_shortened_and_those_that_differ_at_their_end_have_different_folders(bench):
    for minute, end in enumerate("ab"):
        folder = bench.record(f"2024-02-11T03:{minute:02d}:00", end)
        os.rename(folder / f"{end}.fits", folder / ("x" * 240 + f"{end}.fits"))
    state = bench.run()
    names = {one.name.split("/")[1] for one in state.nights["2024-02-10"].reduced.values()}
    assert state.exit_code == 0 and len(names) == 2 and max(map(len, names)) < 130


def test_the_failure_of_a_task_whose_folder_cannot_be_is_told_all_the_same(tmp_path):
    failed = failure(Task("n/g/r", tmp_path / ("x" * 300) / "r", tmp_path / "r.yaml"), "name too long")
    assert failed.failed and failed.problem == "name too long"


@pytest.mark.parametrize("name", [b"torn\xff.fits", b"torn\n irlos: error.fits", b"torn\x1b[2J.fits"])
def test_a_name_that_cannot_be_shown_is_reported_and_the_rest_is_reduced(bench, name):
    bench.record(MORNING)
    (bench.archive / os.fsdecode(name)).write_bytes(b"SIMPLE  = nothing more")
    state = bench.run()
    failures = [line for night in state.nights.values() for line in night.failures]
    assert state.exit_code == 5 and len(failures) == 1 and failures[0].isprintable()
    assert "cannot be shown" in failures[0] and bench.run_folder().is_dir()


# -- links and pipes ----------------------------------------------------------------------------


def test_a_link_to_a_recording_that_is_gone_is_named(bench):
    bench.record(MORNING)
    (bench.archive / "gone.fits").symlink_to("elsewhere.fits")
    state = bench.run()
    failures = [line for night in state.nights.values() for line in night.failures]
    assert state.exit_code == 5 and "gone.fits: not a regular file, or a link" in failures[0]


def test_products_that_were_moved_away_and_linked_are_not_removed(tmp_path):
    run = PublishedRun(tmp_path / "night" / "cube")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "a.h5").write_text("kept")
    run.path.parent.mkdir()
    run.path.symlink_to(tmp_path / "elsewhere")
    (run.prepare() / "a.h5").unlink()
    run.publish()
    assert (tmp_path / "elsewhere" / "a.h5").read_text() == "kept"


def test_results_are_not_written_through_a_folder_that_is_a_link(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "2024-02-10").symlink_to("elsewhere")
    with pytest.raises(IrlosError, match="is a link, through which nothing is written"):
        PublishedRun(tmp_path / "2024-02-10" / "cube" / "recipe").prepare()
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_tree_with_files_of_others_is_refused(bench):
    bench.record(MORNING)
    bench.tree.mkdir()
    (bench.tree / "thesis.tex").touch()
    with pytest.raises(ConfigurationError, match=r"holds other files \(thesis\.tex\)"):
        bench.run()


# -- settings -----------------------------------------------------------------------------------


def test_two_recipes_of_one_name_for_one_kind_are_refused(tmp_path):
    recipes = [f"calibration={tmp_path}/{folder}/quick.yaml" for folder in "ab"]
    with pytest.raises(ConfigurationError, match="have the same name"):
        load_settings(None, recipes)
    load_settings(None, [recipes[0], recipes[1].replace("calibration", "ramp")])


# -- the database and pages -----------------------------------------------------------------------


def test_a_link_in_the_place_of_the_database_is_not_followed(tmp_path):
    (tmp_path / "tree").mkdir()
    (tmp_path / "tree" / database.NAME).symlink_to(tmp_path / "mine.sqlite")
    with pytest.raises(IrlosError, match="no file of our own"), database.opened(tmp_path / "tree"):
        pass
    assert not (tmp_path / "mine.sqlite").exists()


def test_a_database_that_another_program_holds_is_waited_for_and_then_named(tmp_path, monkeypatch):
    monkeypatch.setattr(database, "LOCKED_S", 0.1)
    with database.opened(tmp_path):
        pass
    with sqlite3.connect(tmp_path / database.NAME) as other:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(Locked, match="in use by another program"), database.opened(tmp_path) as found:
            found.descriptions()


def test_a_row_that_makes_no_sense_is_made_again_or_left_out(bench):
    bench.record(MORNING)
    bench.run()
    path = bench.tree / database.NAME
    sound = path.read_bytes()
    for spoil in ROWS:
        path.write_bytes(sound)
        with sqlite3.connect(path) as connection:
            connection.execute(spoil)
        assert bench.run().exit_code == 0, spoil
        there = {path.name for path in bench.folder.iterdir()}
        assert there == {"archive", "tree", "cube.yaml", "ramp.yaml"}, spoil


def test_a_page_that_is_not_utf_8_is_written_again(bench):
    bench.record(MORNING)
    bench.run()
    (bench.tree / "night_2024-02-10.html").write_bytes("Nächte".encode("latin-1"))
    assert bench.run().exit_code == 0 and ">ok<" in bench.page()
