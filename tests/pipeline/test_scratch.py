"""The folder in which a stage keeps finished parts until its product is written."""

import sys
from pathlib import Path

import pytest
from conftest import Bench
from helpers.running import run

from irlos_pipe.conventions.errors import InputDataError
from irlos_pipe.pipeline import Selection


def uses_scratch(bench: Bench, monkeypatch) -> list[Path]:
    """Let `calibrate` keep a part in its scratch folder; returns the folders of its runs."""
    folders, stage = [], sys.modules["irlos_pipe.stages.calibrate.stage"]
    work = stage.run

    def keeping_a_part(ctx):
        folders.append(ctx.scratch)
        ctx.scratch.mkdir(parents=True, exist_ok=True)
        (ctx.scratch / "part").touch()
        return work(ctx)

    monkeypatch.setattr(stage, "run", keeping_a_part)
    return folders


def fails(bench: Bench, *settings: str) -> None:
    bench.make("calibrate.bad_data")
    with pytest.raises(InputDataError):
        run(bench, *settings)
    (bench.data / "calibrate.bad_data").unlink()


def test_parts_outlive_a_run_that_stopped_and_the_next_run_finds_them(bench, monkeypatch):
    folders = uses_scratch(bench, monkeypatch)
    bench.make("calibrate.bad_data")
    for _ in range(2):
        with pytest.raises(InputDataError):
            run(bench)
    assert folders[0] == folders[1] and [file.name for file in folders[0].iterdir()] == ["part"]
    assert folders[0].parent == bench.output / ".partial" and folders[0].name.startswith("calibrate-")


def test_each_setting_has_its_parts_and_all_are_removed_when_the_product_of_the_stage_is_there(
    bench, monkeypatch
):
    folders = uses_scratch(bench, monkeypatch)
    fails(bench)
    fails(bench, "calibrate.solver.iterations=7")
    assert folders[0] != folders[1]
    run(bench, selection=Selection(last="ingest", force=True))  # another stage leaves them alone
    assert folders[0].is_dir()
    run(bench)
    assert len(folders) == 3 and not (bench.output / ".partial").exists()
