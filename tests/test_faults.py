"""What happens to a night's run from outside: kill, full disk, read-only disk, second run, signals, clock.

Truth: an undisturbed run on the same recordings, compared bit by bit but for times. ``make faults`` does
the same at many more moments and places.
"""

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from faults import runs
from faults.harness import Harness, after_harm
from faults.tree import broken, content, leftovers

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def harness(tmp_path_factory) -> Iterator[Harness]:
    with pytest.MonkeyPatch.context() as patches:
        yield Harness(tmp_path_factory.mktemp("faults"), patches)


@pytest.fixture
def tree(harness, request) -> Path:
    return harness.folder / request.node.name


def test_the_undisturbed_run_names_the_damaged_file_and_reduces_the_rest(harness):
    assert harness.end.code == 5 and "damaged.fits" in harness.end.stderr
    products = [name for name in harness.content if name.endswith(".h5")]
    assert len(products) == 9 and not broken(harness.folder / "undisturbed")
    assert leftovers(harness.folder / "undisturbed") == []


@pytest.mark.parametrize("part", [0.3, 0.7])
def test_after_a_kill_nothing_partial_is_seen_and_the_next_run_makes_the_same_bits(harness, tree, part):
    end = harness.killed(tree, part)
    assert end.code in (-signal.SIGPROF, harness.end.code)  # where the first run needed more work
    assert after_harm(tree, end) == [] and harness.after_rerun(tree) == []


@pytest.mark.parametrize("size", [300, 20_000])
def test_a_full_disk_is_reported_in_one_line_and_costs_nothing_once_there_is_room(harness, tree, size):
    end = harness.filled(tree, size)
    assert end.code == 1 and after_harm(tree, end) == []
    assert [line for line in end.stderr.splitlines() if "cannot be written" in line or "disk" in line]
    assert harness.after_rerun(tree) == []


@pytest.mark.parametrize("options", ["size=200k", "nr_inodes=20", "ro"])
def test_a_file_system_without_room_or_inodes_or_read_only_is_reported_in_one_line(harness, tree, options):
    tree.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", tree], capture_output=True).returncode:
        pytest.skip("mounting a file system is not permitted here")
    try:
        end = runs.run(harness.bench, tree)
        assert after_harm(tree, end) == []
    finally:
        subprocess.run(["umount", "--lazy", tree], check=True)
    assert end.code == 1 and end.stderr.count("irlos: error: ") == 1


def test_of_two_runs_on_one_tree_the_second_leaves_with_75_and_the_first_is_not_disturbed(harness, tree):
    first = runs.start(harness.bench, tree)
    while not tree.exists() or all(one.name.startswith(".lock") for one in tree.iterdir()):
        time.sleep(0.001)  # a file that is there is not locked yet
    os.kill(first.pid, signal.SIGSTOP)  # wherever it is, it holds the tree
    second = runs.run(harness.bench, tree)
    os.kill(first.pid, signal.SIGCONT)
    assert second.code == 75 and "in use by another run" in second.stderr
    assert first.end().code == harness.end.code and content(tree) == harness.content


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_night_with_130_and_one_line_and_the_next_run_completes_it(harness, tree, number):
    running = runs.start(harness.bench, tree)
    while not (tree / ".lock").exists():
        time.sleep(0.001)
    os.kill(running.pid, number)
    end = running.end()
    assert end.code == 130 and end.stderr.count("interrupted") == 1 and after_harm(tree, end) == []
    assert harness.after_rerun(tree) == []


def test_inputs_dated_in_the_future_or_long_ago_are_up_to_date_on_the_second_run(harness, tree):
    files = [path for path in harness.bench.archive.rglob("*") if path.is_file()]
    before = {path: path.stat().st_mtime_ns for path in files}
    for path, moment in zip(files, [0, 4_000_000_000] * len(files), strict=False):
        os.utime(path, (moment, moment))
    runs.run(harness.bench, tree)
    stamps = {path: path.stat().st_mtime_ns for path in tree.rglob("*.h5")}
    runs.run(harness.bench, tree)
    assert {path: path.stat().st_mtime_ns for path in tree.rglob("*.h5")} == stamps
    for path, moment in before.items():
        os.utime(path, ns=(moment, moment))


def test_beside_a_program_that_writes_a_recording_a_night_ends_and_the_next_is_whole(harness, tree):
    """The last: afterwards the recordings have other times."""
    assert harness.beside_a_writer(tree)[1] == []
