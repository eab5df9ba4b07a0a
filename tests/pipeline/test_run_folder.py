"""What a run may touch: nothing of others, nothing through links; and what makes its results invalid."""

import os
import sys
from dataclasses import replace

import pytest
import yaml
from helpers.patience import within
from helpers.running import reasons, results, run, visible
from helpers.sparta_files import counts, star, write_recorder

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError, IrlosError
from irlos_pipe.pipeline import run_recipe
from irlos_pipe.pipeline.inputs import CACHE_NAME
from irlos_pipe.product.runfolder import RunFolder, require_free
from irlos_pipe.product.storage import read_product, write_product
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


def test_empty_folders_and_those_of_earlier_runs_are_used(bench):
    bench.output.mkdir()
    (bench.output / ".nfs0001").touch()
    (bench.output / "run.log").touch()  # of a run that was killed at once
    run(bench)
    (bench.output / "notes.txt").touch()
    assert bench.run().exit_code == 0


def test_a_file_in_the_place_of_the_folder_is_named(tmp_path):
    (tmp_path / "out").touch()
    with pytest.raises(ConfigurationError, match="is a file; give a folder"):
        require_free(tmp_path / "out")


# -- links and pipes ----------------------------------------------------------------------------


def test_the_log_is_not_written_through_a_link(bench, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    bench.output.mkdir()
    (bench.output / "run.log").symlink_to(tmp_path / "mine.txt")
    with pytest.raises(IrlosError, match=r"run\.log: cannot be written: a link, which is not followed"):
        run(bench)
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_parts_of_earlier_runs_are_not_removed_through_a_link(bench, tmp_path):
    (tmp_path / "mine" / "ingest-0").mkdir(parents=True)
    bench.output.mkdir()
    (bench.output / ".partial").symlink_to(tmp_path / "mine")
    run(bench)
    assert (tmp_path / "mine" / "ingest-0").is_dir()


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


def test_a_pipe_among_the_input_files_is_not_read(bench):
    os.mkfifo(bench.data / "notes")
    run(bench)
    assert reasons(bench)["ingest"] == "up to date"


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


def test_a_product_of_an_earlier_version_which_has_no_checksums_of_its_files_stays(bench):
    run(bench)
    path = bench.output / "02_calibrate.h5"
    product = read_product(path)
    provenance = {key: value for key, value in product.provenance.items() if key != "file_sha256"}
    write_product(replace(product, provenance=provenance), path)
    assert reasons(bench)["calibrate"] == "up to date"


def test_after_a_failed_run_no_old_deliverable_or_report_looks_like_its_result(bench):
    run(bench)
    bench.make("ingest.bad_data")
    with pytest.raises(InputDataError):
        run(bench)
    assert results(bench)["status"] == "failed"
    assert not {"table.csv", "report.html"} & set(visible(bench))
    assert sorted(os.listdir(bench.output / "earlier")) == ["report.html", "table.csv"]


def test_what_another_recipe_left_is_set_aside(bench):
    run(bench)
    content = yaml.safe_load(bench.recipe.read_text())
    stages = {key: content[key] for key in ("recipe", "inputs")} | {"stages": ["ingest", "lift"]}
    bench.recipe.write_text(yaml.safe_dump(stages))
    run(bench)
    assert {"02_calibrate.h5", "03_lift.h5", "table.csv"} == set(os.listdir(bench.output / "earlier"))
    assert "table.csv" not in visible(bench) and read_product(bench.output / "02_lift.h5").stage == "lift"
    assert list(RunFolder(bench.output).products()) == ["ingest", "lift"]
