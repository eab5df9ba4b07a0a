"""`irlos night` on stand-in stages: what is reduced, what is reported, and what survives errors."""

import contextlib
import os
import shutil
import sqlite3
import sys
import time
from dataclasses import replace

import pytest
from helpers.fake_stages import COUNTS
from helpers.night_bench import night_bench  # noqa: F401 - the fixture `bench`

from irlos_pipe.conventions.errors import NothingToDo
from irlos_pipe.night.database import NAME, opened
from irlos_pipe.night.run import plan_night, run_night
from irlos_pipe.night.terminal import plan_text

MORNING = "2024-02-11T03:00:00"


def contents(folder) -> dict[str, bytes]:
    files = (path for path in folder.iterdir() if path.is_file())
    return {path.name: path.read_bytes() for path in files if path.name != ".lock"}


def change_model(monkeypatch, stage: str = "calibrate") -> None:
    monkeypatch.setattr(sys.modules[f"irlos_pipe.stages.{stage}.stage"], "VERSION", 2)


@pytest.mark.slow
def test_a_second_run_works_only_on_what_is_new_or_changed_and_changes_no_other_file(bench):
    changed = bench.record(MORNING)
    bench.record("2024-02-11T03:10:00", "offset", role="defocus_ramp", introduced_defocus_nm=10.0)
    bench.run()
    before, page = contents(bench.run_folder()), bench.page()
    state = bench.run()
    assert [one.action for one in state.nights["2024-02-10"].reduced.values()] == 2 * ["up to date"]
    assert COUNTS["ingest"] == COUNTS["calibrate"] == COUNTS["lift"] == 2
    assert contents(bench.run_folder()) == before and bench.page() == page
    bench.record("2024-02-11T04:00:00", "later")  # the same frames at another time
    (changed / "numbers.json").write_text('{"4": 31.0}')
    reduced = bench.run().nights["2024-02-10"].reduced.values()
    actions = {one.name.split("/")[1]: one.action for one in reduced}
    assert actions == {"030000_cube": "redone", "031000_offset": "redone", "040000_later": "new"}


@pytest.mark.parametrize(
    ("behaviour", "message"),
    [("ingest.bad_data", "HDU 1 is truncated"), ("calibrate.crash", "unexpected ZeroDivisionError: a bug")],
)
def test_a_reduction_that_fails_is_named_and_the_others_continue(bench, behaviour, message):
    (bench.record(MORNING, "poor") / behaviour).touch()
    assert bench.run().exit_code == 3
    bench.record("2024-02-11T04:00:00", "good")
    state = bench.run()
    assert state.exit_code == 5 and message in state.nights["2024-02-10"].failures[0]
    assert not bench.run_folder(group="030000_poor").exists()
    assert bench.run_folder(group="040000_good").is_dir() and message in bench.page()


@pytest.mark.parametrize(
    ("largest_nm", "flag", "code", "message"),
    [(500.0, "", 4, "a QC limit failed"), (5.0, "ingest.partial", 5, "some exposures failed")],
)
def test_a_failed_limit_is_exit_code_4_and_failed_exposures_are_5(bench, largest_nm, flag, code, message):
    folder = bench.record(MORNING, numbers={"4": largest_nm})
    (folder / (flag or "nothing")).touch()
    assert bench.run().exit_code == code and message in bench.page()


@pytest.mark.slow
def test_a_ramp_uses_a_calibration_that_an_earlier_run_found(bench):
    bench.record("2024-02-09T03:00:00")
    bench.run()
    bench.record(MORNING, "offset", role="defocus_ramp", introduced_defocus_nm=10.0)
    assert bench.run(bench.night("2024-02-11")).exit_code == 0
    recipe = bench.run_folder(group="030000_offset", recipe="ramp") / "recipe.resolved.yaml"
    assert "2024-02-09/cube" in recipe.read_text()


@pytest.mark.slow
def test_a_ramp_is_served_by_the_calibration_that_passed_and_the_failed_one_is_in_no_number(bench):
    bench.record("2024-02-11T02:00:00", "good")
    bench.record("2024-02-11T02:50:00", "double", numbers={"4": 500.0})
    bench.record("2024-02-11T03:00:00", "offset", role="defocus_ramp", introduced_defocus_nm=10.0)
    state = bench.run()
    assert state.exit_code == 4
    recipe = bench.run_folder(group="030000_offset", recipe="ramp") / "recipe.resolved.yaml"
    assert "/good" in recipe.read_text() and "/double" not in recipe.read_text()
    assert "not double: failed calibrate: largest" in bench.page()
    with opened(bench.tree) as database:
        assert {point.run.split("/")[1] for point in database.points()} == {"020000_good", "030000_offset"}


# -- nights with nothing, crashes, locks ------------------------------------------------------


@pytest.mark.parametrize("role", ["", "psf"])
def test_a_night_with_nothing_to_reduce_has_a_page_that_says_so(bench, role):
    bench.night("2024-02-10").mkdir()
    message = "no recordings"
    if role:
        bench.record("2024-02-10T22:00:00", "science", role=role)
        message = "nothing to reduce; science: no recipe for groups of kind psf"
    with pytest.raises(NothingToDo, match=message):
        bench.run(bench.night("2024-02-10"))
    page = bench.page()
    assert "Nothing to process" in page and ">empty<" in page and ("science" in page) == bool(role)


def test_a_night_with_nothing_but_a_ramp_without_calibration_needs_a_look(bench):
    bench.record(MORNING, "offset", role="defocus_ramp", introduced_defocus_nm=10.0)
    state = bench.run()
    assert state.exit_code == 3
    assert "offset: no calibration cube of its configuration" in state.nights["2024-02-10"].failures[0]
    assert ">needs a look<" in bench.page()


@pytest.mark.parametrize(
    ("error", "message"),
    [(RuntimeError("a bug"), "unexpected RuntimeError: a bug"), (KeyboardInterrupt(), "interrupted")],
)
def test_a_crash_is_stated_on_the_page_and_the_next_run_completes_the_night(bench, error, message):
    bench.record(MORNING)

    def runner(work, tasks):
        yield from map(work, tasks[:0])
        raise error

    with pytest.raises(type(error)):
        run_night(bench.request(), runner)
    assert message in bench.page() and ">stopped<" in bench.page() and "not finished" in bench.page()
    assert bench.run().exit_code == 0 and ">ok<" in bench.page()


def test_numbers_that_a_killed_run_did_not_store_are_stored_by_the_next_run(bench):
    bench.record(MORNING)
    bench.run()
    with sqlite3.connect(bench.tree / NAME) as connection:
        connection.execute("UPDATE runs SET key = 'old'")
        connection.execute("DELETE FROM numbers")
    bench.run()
    with opened(bench.tree) as database:
        found = {one.name: one.value for one in database.points() if one.name.startswith("noll")}
    assert found == {"noll_4_nm": 30.0, "noll_5_nm": -10.0}


# -- reprocessing ------------------------------------------------------------------------------


@pytest.mark.slow
def test_after_a_change_exactly_the_stages_that_depend_on_it_are_redone_with_the_reason(bench, monkeypatch):
    for day in (11, 12):
        bench.record(f"2024-02-{day}T03:00:00")
    bench.run()
    change_model(monkeypatch, "lift")
    state = bench.run()
    assert (COUNTS["ingest"], COUNTS["calibrate"], COUNTS["lift"]) == (2, 2, 4)
    for night in state.nights.values():
        (reduced,) = night.reduced.values()
        assert reduced.action == "redone"
        assert reduced.reasons == ("lift: redone because stage version 1 -> 2",)
        assert "stage version 1 -&gt; 2" in bench.page(night.date)


@pytest.mark.slow
def test_old_products_stay_complete_when_a_later_stage_of_the_new_ones_fails(bench, monkeypatch):
    folder = bench.record(MORNING)
    bench.run()
    before = contents(bench.run_folder())
    change_model(monkeypatch)
    (folder / "lift.crash").touch()
    state = bench.run()
    assert state.exit_code == 3 and COUNTS["calibrate"] == 2
    assert contents(bench.run_folder()) == before
    (folder / "lift.crash").unlink()
    assert bench.run().exit_code == 0
    after = contents(bench.run_folder())
    assert after["02_calibrate.h5"] != before["02_calibrate.h5"] and not list(folder.glob(".*.part"))


def _interrupted(_):
    raise KeyboardInterrupt


@pytest.mark.slow
def test_a_reverted_change_keeps_the_old_products_and_removes_unfinished_ones(bench, monkeypatch):
    bench.record(MORNING)
    bench.run()
    with monkeypatch.context() as patch:
        change_model(patch, "ingest")
        patch.setattr(sys.modules["irlos_pipe.stages.lift.stage"], "run", _interrupted)
        with pytest.raises(KeyboardInterrupt):
            bench.run()
    assert len(list(bench.run_folder().parent.iterdir())) == 2  # and the new products
    assert bench.run().exit_code == 0 and COUNTS["lift"] == 1
    assert len(list(bench.run_folder().parent.iterdir())) == 1


def test_nights_before_the_first_date_are_skipped(bench):
    for day in (11, 12):
        bench.record(f"2024-02-{day}T03:00:00")
    assert list(bench.run(since="2024-02-11").nights) == ["2024-02-11"]


def test_a_foreign_folder_in_the_place_of_a_group_is_not_touched(bench):
    bench.record(MORNING)
    (bench.run_folder()).mkdir(parents=True)
    (bench.run_folder() / "mine.txt").touch()
    (bench.tree / "night.log").touch()
    state = bench.run()
    assert "is in the way" in state.nights["2024-02-10"].failures[0]
    assert os.listdir(bench.run_folder()) == ["mine.txt"]


# -- what is known, what is a copy, what hangs --------------------------------------------------


@pytest.mark.slow
def test_what_is_acknowledged_once_is_shown_and_not_reported_again_until_it_changes(bench):
    bench.record(MORNING)
    torn = bench.record("2024-02-11T03:30:00", "torn") / "torn.fits"
    torn.write_bytes(torn.read_bytes()[:3000])
    doubtful = bench.record("2024-02-11T04:00:00", "large", numbers={"4": 500.0})
    request = bench.request()
    assert bench.run().exit_code == 5
    in_order = lambda work, tasks: map(work, tasks)  # noqa: E731
    state = run_night(replace(request, acknowledge=True), in_order)
    assert state.exit_code == 0 and "torn.fits" in (bench.tree / "acknowledged.txt").read_text()
    state = bench.run()
    assert state.exit_code == 0 and not any(night.failures for night in state.nights.values())
    assert "torn.fits" in state.nights["2024-02-11"].known[0]
    assert "a QC limit failed" in state.nights["2024-02-10"].known[0]
    assert "acknowledged earlier" in bench.page("2024-02-11") and ">ok<" in bench.page("2024-02-11")
    (doubtful / "calibrate.crash").touch()
    (doubtful / "numbers.json").write_text('{"4": 600.0}')
    assert bench.run().exit_code == 5
    (bench.tree / "acknowledged.txt").write_text("# nothing\n")
    assert "torn.fits" in bench.run().nights["2024-02-11"].failures[0]


def test_a_copy_is_left_out_and_the_same_frames_with_another_side_car_are_a_failure(bench):
    folder = bench.record(MORNING)
    shutil.copytree(folder, bench.night("2024-02-11") / "again")
    assert "a copy of" in plan_text(*plan_night(bench.request()), as_json=False)
    state = bench.run()
    night = state.nights["2024-02-10"]
    assert state.exit_code == 0 and len(night.reduced) == 1
    assert "a copy of" in night.left_out[0].reason and "a copy of" in bench.page()
    bench.record(MORNING, "other", target="HD 2")
    state = bench.run()
    assert state.exit_code == 5 and "but another side-car" in state.nights["2024-02-10"].failures[0]


@pytest.mark.slow
def test_a_reduction_that_hangs_is_stopped_and_the_others_go_on(bench, monkeypatch):
    bench.record(MORNING, "hanging")
    bench.record("2024-02-11T04:00:00", "good")
    work = sys.modules["irlos_pipe.stages.calibrate.stage"].run

    def hang_or_work(ctx):
        if "hanging" in str(next(iter(ctx.inputs.values()))[0]):
            with contextlib.suppress(Exception):  # as code that goes on after any error
                time.sleep(60)
        return work(ctx)

    monkeypatch.setattr(sys.modules["irlos_pipe.stages.calibrate.stage"], "run", hang_or_work)
    request = bench.request()
    request = replace(request, settings=request.settings.model_copy(update={"limit_min": 0.02}))
    state = run_night(request, lambda work, tasks: map(work, tasks))
    night = state.nights["2024-02-10"]
    assert state.exit_code == 5 and "took longer than 0.02 min and was stopped" in night.failures[0]
    assert night.reduced["2024-02-10/040000_good/cube"].status == "ok"
