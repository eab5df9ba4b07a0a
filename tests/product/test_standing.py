"""The stamp of a run holds as long as nothing is touched that its products depend on."""

import os
import shutil
import sys

import pytest
from conftest import invoke

from irlos_pipe.product.runfolder import RunFolder, is_standing


@pytest.fixture
def run(bench) -> RunFolder:
    bench.run()
    run = RunFolder(bench.output)
    assert is_standing(run)
    return run


def later(path) -> None:
    os.utime(path, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns + 1))


def test_a_status_without_changes_does_not_make_a_plan(bench, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "irlos_pipe.pipeline.plan", None)  # importing it fails
    lines = invoke("status", str(bench.output)).stdout.splitlines()
    assert [line.split()[0] for line in lines[1:]] == ["01_ingest.h5", "02_calibrate.h5", "03_lift.h5"]
    assert all("up to date" in line for line in lines[1:])


@pytest.mark.parametrize(
    "change",
    [
        lambda bench: later(bench.data / "a.dat"),
        lambda bench: (bench.data / "c.dat").write_bytes(b"1"),
        lambda bench: (bench.data / "b.dat").unlink(),
        lambda bench: later(bench.output / "recipe.resolved.yaml"),
        lambda bench: (bench.output / "02_calibrate.h5").unlink(),
        lambda bench: later(bench.output / "03_lift.h5"),
        lambda bench: shutil.move(bench.data, bench.folder / "elsewhere"),
    ],
)
def test_whatever_is_touched_breaks_the_stamp(bench, run, change):
    change(bench)
    assert not is_standing(run)


def test_a_run_of_a_part_and_a_link_to_a_folder_leave_no_stamp(bench):
    bench.run("--to", "calibrate")
    assert not is_standing(RunFolder(bench.output))
    (bench.folder / "other").mkdir()
    (bench.data / "link").symlink_to(bench.folder / "other")
    bench.run()
    assert not is_standing(RunFolder(bench.output))
