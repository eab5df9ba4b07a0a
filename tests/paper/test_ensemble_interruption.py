"""A long stage that is ended half way keeps its finished samples, and leaves none when it is done."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
from conftest import Bench, products
from helpers.ensemble_cases import NAMES, computed, lift
from helpers.paths import HELPERS, REPOSITORY

pytestmark = pytest.mark.slow


def start(bench: Bench) -> subprocess.Popen:
    """Start ``irlos run`` in a process group of its own, as a terminal does."""
    options = ["--output", bench.output, "--device", "cpu", "--jobs", "2"]
    paths = [str(REPOSITORY), str(HELPERS.parent), os.environ.get("PYTHONPATH", "")]
    return subprocess.Popen(
        [sys.executable, HELPERS / "ensemble_cases.py", "run", bench.recipe, *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))},
        start_new_session=True,
    )


def until(condition, seconds: float = 30) -> None:
    """Wait for something that another process does."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def end_while_a_sample_is_held(bench: Bench, how) -> subprocess.Popen:
    """End the run when all samples but the third are finished."""
    (marks(bench) / "c.hold").touch()
    process = start(bench)
    until((marks(bench) / "c.waiting").exists)
    until(lambda: len(list(bench.output.glob(".partial/lift-*/*.npz"))) == len(NAMES) - 1)
    how(process)
    return process


def marks(bench: Bench) -> Path:
    folder = bench.folder / "marks"
    folder.mkdir(exist_ok=True)
    return folder


def members(group: int) -> list[int]:
    """Processes of a group that are not zombies."""
    listed = subprocess.check_output(["ps", "-A", "-o", "pid=,pgid=,stat="], text=True)
    rows = [line.split() for line in listed.splitlines()]
    return [int(pid) for pid, of, state in rows if int(of) == group and not state.startswith("Z")]


def goes_on(bench: Bench) -> None:
    """The next run computes only the sample that was held, and leaves nothing but its product."""
    computed(marks(bench))
    (marks(bench) / "c.hold").unlink()
    sys.modules["irlos_pipe.stages.lift.stage"].run = lift
    assert bench.run().exit_code == 0
    assert computed(marks(bench)) == ["c"]
    assert products(bench.output)[-1] == "03_lift.h5" and not (bench.output / ".partial").exists()


def test_a_signal_to_all_processes_ends_them_with_one_line_and_the_next_run_goes_on(bench):
    process = end_while_a_sample_is_held(bench, lambda process: os.killpg(process.pid, signal.SIGTERM))
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 130 and "Traceback" not in errors
    assert [line for line in errors.splitlines() if "error" in line] == [
        "irlos: error: interrupted; finished products are kept, run the same command to continue"
    ]
    until(lambda: members(process.pid) == [])
    assert "03_lift.h5" not in products(bench.output)
    goes_on(bench)


def test_workers_end_when_the_run_is_killed_and_the_next_run_goes_on(bench):
    process = end_while_a_sample_is_held(bench, lambda process: process.kill())
    process.wait()
    until(lambda: members(process.pid) == [])
    goes_on(bench)


def test_a_worker_that_is_killed_ends_the_run_with_one_line_and_the_next_run_goes_on(bench):
    process = end_while_a_sample_is_held(bench, kill_workers)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == 1
    assert [line for line in errors.splitlines() if "error" in line] == [
        "irlos: error: draws: a worker process was killed, perhaps because memory ran out; finished samples "
        "stay: run the same command to go on, with fewer --jobs"
    ]
    goes_on(bench)


def kill_workers(process: subprocess.Popen) -> None:
    for pid in members(process.pid):
        with suppress(FileNotFoundError, ProcessLookupError):  # one may have ended since it was listed
            if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes():
                os.kill(pid, signal.SIGKILL)
