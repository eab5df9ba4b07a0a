"""What a run may touch: nothing of others, nothing through links; and what makes its results invalid."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import Bench, invoke, products
from filelock import FileLock
from helpers.patience import within
from helpers.running import reasons, results, run, visible

import irlos_pipe
from irlos_pipe.conventions.errors import InputDataError, IrlosError
from irlos_pipe.pipeline import Selection
from irlos_pipe.pipeline import run as runs
from irlos_pipe.pipeline.plan import CACHE_NAME
from irlos_pipe.product.run_table import link_latest, version_folders


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


def test_deliverables_of_stages_that_were_not_run_again_do_not_stand_beside_other_results(bench):
    run(bench)
    assert bench.run("--to", "ingest", "--set", "ingest.scale=2").exit_code == 0
    assert "table.csv" not in visible(bench)
    assert os.listdir(bench.output / "earlier") == ["table.csv"]
    run(bench)
    assert "table.csv" in visible(bench)


# Versions of a reduction side by side: what is there is not changed, the link leads to what is whole.


def numbered(bench: Bench, *options: str) -> int:
    return bench.run("--numbered", *options).exit_code


def there(bench: Bench) -> list[str]:
    return [path.name for path in version_folders(bench.output)]


def content(bench: Bench, version: str) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (bench.output / version).glob("*.h5")}


def test_the_first_version_is_the_latest_and_the_same_reduction_again_up_to_date(bench):
    assert numbered(bench) == 0
    assert there(bench) == ["001"] and os.readlink(bench.output / "latest") == "001"
    before = content(bench, "001")
    assert len(products(bench.output / "latest")) == 3
    assert numbered(bench) == 0 and there(bench) == ["001"] and content(bench, "001") == before


@pytest.mark.parametrize("option", [("--set", "calibrate.method=dip_global"), ("--force",), ()])
def test_a_reduction_that_would_replace_products_begins_a_version(bench, option):
    numbered(bench)
    before = content(bench, "001")
    if not option:
        (bench.data / "c.dat").write_bytes(b"1")
    assert numbered(bench, *option) == 0
    assert there(bench) == ["001", "002"] and os.readlink(bench.output / "latest") == "002"
    assert content(bench, "001") == before


def test_a_version_that_stopped_is_continued_and_the_link_stays_until_it_is_whole(bench):
    numbered(bench)
    bench.make("calibrate.crash")
    changed = ("--set", "ingest.scale=2")
    assert numbered(bench, *changed) == 1
    assert there(bench) == ["001", "002"] and os.readlink(bench.output / "latest") == "001"
    (bench.data / "calibrate.crash").unlink()
    # what made it crash was an input file, so that ingest differs: a version that stopped early is kept
    assert numbered(bench, *changed) == 0
    assert there(bench)[-1] == os.readlink(bench.output / "latest")


def test_a_folder_of_versions_is_no_run_and_the_message_says_where_one_is(bench):
    numbered(bench)
    assert "holds other files (001 (and" not in bench.run().stdout
    result = invoke("report", str(bench.output))
    assert result.exit_code == 3 and f"{bench.output / 'latest'}" in result.stderr


def test_latest_that_is_no_link_is_refused_and_left_alone(bench):
    numbered(bench)
    (bench.output / "latest").unlink()
    (bench.output / "latest").mkdir()
    result = bench.run("--numbered", "--force")
    assert result.exit_code == 2 and "latest: is no link" in result.stderr
    link_latest(bench.output, bench.output / "001")
    assert {path.name for path in bench.output.iterdir()} == {".lock", "001", "latest"}


def test_on_a_disk_without_links_the_newest_version_is_named(bench, monkeypatch):
    def unsupported(*_, **__):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(os, "symlink", unsupported)
    for option in ((), ("--force",)):
        result = bench.run("--numbered", *option)
        assert result.exit_code == 0
    assert f"the newest complete version is {bench.output / '002'}" in result.stderr
    assert "latest" in invoke("status", str(bench.output)).stdout.splitlines()[2]
    assert f"{bench.output / '002'}" in invoke("report", str(bench.output)).stderr


def test_two_runs_do_not_share_a_number(bench):
    numbered(bench)
    with FileLock(bench.output / ".lock"):
        assert numbered(bench, "--force") == 75
    assert there(bench) == ["001"]


# Where a product comes from: the revision of the software, with git or without.


@pytest.fixture
def version(monkeypatch):
    """Return the version that a package in a folder states."""

    def stated(folder) -> str:
        monkeypatch.setattr(irlos_pipe, "__file__", str(folder / "irlos_pipe" / "__init__.py"))
        runs.software_versions.cache_clear()
        return runs.software_versions()["irlos_pipe"]

    yield stated
    runs.software_versions.cache_clear()


def git(folder, *arguments):
    identity = ("-c", "user.name=x", "-c", "user.email=x@example.org")
    return subprocess.run(
        ["git", "-C", folder, *identity, *arguments], check=True, capture_output=True, text=True
    )


def test_a_checkout_states_its_revision_and_whether_it_was_changed(version, tmp_path):
    git(tmp_path, "init", "-q")
    (tmp_path / "file").write_text("1")
    git(tmp_path, "add", "file")
    git(tmp_path, "commit", "-qm", "one")
    revision = git(tmp_path, "rev-parse", "--short", "HEAD").stdout.strip()
    assert version(tmp_path) == f"{irlos_pipe.__version__}+git.{revision}"
    (tmp_path / "file").write_text("2")
    git(tmp_path, "tag", "-a", "v1", "-m", "v1")  # does not hide the revision
    assert version(tmp_path) == f"{irlos_pipe.__version__}+git.{revision}.dirty"


# The folder in which a stage keeps finished parts until its product is written.


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
