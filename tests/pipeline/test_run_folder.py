"""What a run may touch: nothing of others, nothing through links; and what makes its results invalid."""

import os
import sys

import pytest
from helpers.patience import within
from helpers.running import reasons, results, run, visible
from helpers.sparta_files import counts, star, write_recorder

from irlos_pipe.conventions.errors import InputDataError, IrlosError
from irlos_pipe.pipeline import run_recipe
from irlos_pipe.pipeline.inputs import CACHE_NAME
from irlos_pipe.recipe import load_recipe


@pytest.fixture(autouse=True)
def patient():
    with within(30):
        yield


# -- folders of others --------------------------------------------------------------------------


def test_a_folder_with_files_of_others_is_refused_and_left_alone(bench):
    bench.output.mkdir()
    for name in ("results.json", ".thesis.tex.part"):
        (bench.output / name).write_text("mine")
    result = bench.run()
    assert result.exit_code == 2 and "holds other files (results.json)" in result.output
    assert sorted(os.listdir(bench.output)) == [".thesis.tex.part", "results.json"]
    assert bench.run("--dry-run").exit_code == 2


# -- links and pipes ----------------------------------------------------------------------------


def test_the_log_is_not_written_through_a_link(bench, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    bench.output.mkdir()
    (bench.output / "run.log").symlink_to(tmp_path / "mine.txt")
    with pytest.raises(IrlosError, match=r"run\.log: cannot be written: a link, which is not followed"):
        run(bench)
    assert (tmp_path / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize("name", [CACHE_NAME, "run.log"])
def test_a_pipe_in_the_folder_of_a_run_blocks_nothing(bench, name):
    run(bench)
    (bench.output / name).unlink()
    os.mkfifo(bench.output / name)
    assert bench.run().exit_code in (0, 1)


def test_a_recording_that_is_gone_does_not_stop_the_run(tmp_path):
    write_recorder(tmp_path / "in" / "sky", counts(star(12, 12), 3))
    (tmp_path / "in" / "gone.fits").symlink_to("elsewhere.fits")
    (tmp_path / "recipe.yaml").write_text("recipe: test\ninputs: {cube: in}\nstages: [ingest]\n")
    outcome = run_recipe(load_recipe(tmp_path / "recipe.yaml"), tmp_path / "out")
    assert outcome.exit_code in (4, 5) and len(outcome.results["stages"]["ingest"]["inputs"]) == 1


# -- what makes products out of date --------------------------------------------------------------


def test_other_content_of_the_same_size_and_time_is_noticed(bench):
    run(bench)
    path = bench.data / "a.dat"
    before = path.stat()
    path.write_bytes(b"54321")
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert "a.dat changed" in reasons(bench)["ingest"]


def test_a_file_that_changes_during_the_run_is_an_error_not_a_product(bench, monkeypatch):
    stage = sys.modules["irlos_pipe.stages.ingest.stage"]
    true = stage.run

    def changing(ctx):
        output = true(ctx)
        (bench.data / "b.dat").write_bytes(b"more")
        return output

    monkeypatch.setattr(stage, "run", changing)
    with pytest.raises(InputDataError, match=r"b\.dat: changed during the run"):
        run(bench)
    assert "01_ingest.h5" not in visible(bench)


@pytest.mark.parametrize("content", [b"mode,nm\n4,1\n", b"mod", b""])
def test_an_edited_deliverable_is_made_again(bench, content):
    run(bench)
    (bench.output / "table.csv").write_bytes(content)
    assert reasons(bench)["calibrate"] == "table.csv was changed"
    run(bench)
    assert (bench.output / "table.csv").read_bytes() == b"mode,nm\n"


def test_after_a_failed_run_no_old_deliverable_or_report_looks_like_its_result(bench):
    run(bench)
    bench.make("ingest.bad_data")
    with pytest.raises(InputDataError):
        run(bench)
    assert results(bench)["status"] == "failed"
    assert not {"table.csv", "report.html"} & set(visible(bench))
    assert sorted(os.listdir(bench.output / "earlier")) == ["report.html", "table.csv"]
