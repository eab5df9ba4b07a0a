"""Tasks in processes of this machine."""

import os
import signal
from pathlib import Path

import pytest

from irlos_pipe.night.engines import local_runner
from irlos_pipe.night.reduce import Reduced, Task


def reduce_or_die(task: Task) -> Reduced:
    if task.name == "bad":
        os.kill(os.getpid(), signal.SIGKILL)
    return Reduced(task.name, task.folder, "new")


@pytest.mark.slow
def test_a_killed_process_costs_only_its_own_task(tmp_path):
    tasks = [Task(name, tmp_path / name, Path("recipe.yaml")) for name in ("bad", "good")]
    found = {one.name: one for one in local_runner(1)(reduce_or_die, tasks)}
    assert [name for name, one in sorted(found.items()) if one.failed] == ["bad"]
    assert found["good"].action == "new" and "its process was killed" in found["bad"].problem


def test_without_tasks_no_process_is_started(tmp_path):
    assert list(local_runner(2)(reduce_or_die, [])) == []
