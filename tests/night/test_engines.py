"""Tasks in processes of this machine, and on a Dask cluster: the same bits, whichever worker dies.

Truth: the same recipe run stage after stage in this process. The cluster has two workers, each a
process of one thread.
"""

import os
import signal
import sys
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from conftest import invoke
from helpers import sparta_files

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.night import engines
from irlos_pipe.night.reduce import Reduced, Task, reduce_group
from irlos_pipe.pipeline import Resources, run_recipe
from irlos_pipe.pipeline import run as runs
from irlos_pipe.product.storage import read_product

RECIPE = """\
recipe: small
inputs: {calibration: none}
stages: [ingest, calibrate]
calibrate: {method: lift_avg, highest_noll: 6, max_iterations: 3}
"""
NAMES = ("a", "b", "c")
pytestmark = pytest.mark.xdist_group("engines")  # one cluster for all
ALLOWED_DEATHS = 1  # of workers at one task; Dask's default is 3


@pytest.fixture(scope="module")
def address():
    distributed = pytest.importorskip("distributed", reason="Dask is not installed: pip install -e '.[dask]'")
    import dask

    options = {"dashboard_address": None, "worker_dashboard_address": None, "silence_logs": "CRITICAL"}
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": ALLOWED_DEATHS}),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, **options) as cluster,
    ):
        yield cluster.scheduler_address


@pytest.fixture
def tasks(tmp_path) -> list[Task]:
    """Three calibrations of different stars."""
    recipe = tmp_path / "small.yaml"
    recipe.write_text(RECIPE)
    for seed, name in enumerate(NAMES):
        adu = sparta_files.counts(sparta_files.star(16, 16, seed=seed), frames=4, seed=seed)
        sparta_files.write_recorder(tmp_path / "data" / name, adu)
    return [
        Task(
            f"night/{name}/small",
            tmp_path / "tree" / name,
            recipe,
            inputs=(f"calibration={tmp_path / 'data' / name}",),
        )
        for name in NAMES
    ]


def on_dask(address: str, work, tasks: list[Task]) -> dict[str, Reduced]:
    return {one.name: one for one in engines.dask_runner(address)(work, tasks)}


def marked(marks: Path, task: Task, last: str, before: Reduced | None, hold: str = "") -> Reduced:
    """Run `reduce_group`, write a mark with the process of every try, and hold the first try at one stage."""
    from irlos_pipe.stages import STAGES

    stage, work = STAGES[last], STAGES[last].run

    def run(ctx):
        tries = len(list(marks.glob(f"{task.folder.name}-{last}-*")))
        (marks / f"{task.folder.name}-{last}-{tries}").write_text(str(os.getpid()))
        if hold == f"{task.folder.name}-{last}" and tries == 0:
            time.sleep(600)
        return work(ctx)

    stage.run = run
    try:
        return reduce_group(task, last, before)
    finally:
        stage.run = work


def kill_marked(mark: Path) -> None:
    """Wait for a mark and kill the process that wrote it."""
    end = time.monotonic() + 120
    while time.monotonic() < end:
        if mark.exists() and mark.read_text():
            os.kill(int(mark.read_text()), signal.SIGKILL)
            return
        time.sleep(0.05)


def same_to_the_bit(task: Task, folder: Path) -> None:
    run_recipe(task.load(), folder, resources=Resources(report=False))
    for name in ("01_ingest.h5", "02_calibrate.h5"):
        ours, serial = read_product(task.folder / name), read_product(folder / name)
        assert list(ours.arrays) == list(serial.arrays)
        for key, quantity in serial.arrays.items():
            assert quantity.value.tobytes() == ours.arrays[key].value.tobytes(), key
        assert ours.results | {"seconds": 0} == serial.results | {"seconds": 0}
        assert (ours.checks, ours.config) == (serial.checks, serial.config)


@pytest.mark.slow
def test_a_worker_killed_during_a_stage_costs_only_that_stage_and_changes_no_bit(address, tasks, tmp_path):
    marks = tmp_path / "marks"
    marks.mkdir()
    killer = threading.Thread(target=kill_marked, args=(marks / "b-calibrate-0",))
    killer.start()
    tasks = tasks[:2]
    done = on_dask(address, partial(marked, marks, hold="b-calibrate"), tasks)
    killer.join()
    assert [done[task.name].problem for task in tasks] == ["", ""]
    tries = sorted(mark.name for mark in marks.iterdir())
    assert "b-calibrate-1" in tries and "b-ingest-1" not in tries and "a-calibrate-1" not in tries
    assert len({mark.read_text() for mark in marks.iterdir()}) >= 2
    for task in tasks:
        same_to_the_bit(task, tmp_path / "serial" / task.folder.name)
    one, other = (read_product(task.folder / "02_calibrate.h5").arrays["zernike_nm"].value for task in tasks)
    assert not np.array_equal(one, other)


@pytest.mark.slow
def test_a_task_that_fails_or_kills_every_worker_is_reported_and_the_others_are_reduced(address, tasks):
    done = on_dask(address, deadly, tasks)
    assert "KilledWorker" in done[tasks[0].name].problem and done[tasks[0].name].failed
    assert done[tasks[1].name].problem == "b: no star"
    # each stage gets the outcome of the stage before
    assert done[tasks[2].name].status == "ok" and done[tasks[2].name].reasons == ("ingest", "calibrate")


def deadly(task: Task, last: str = "", before: Reduced | None = None) -> Reduced:
    if task.folder.name == "a":
        os.kill(os.getpid(), signal.SIGKILL)
    if task.folder.name == "b":
        return Reduced(task.name, task.folder, "failed", "failed", problem="b: no star")
    return Reduced(task.name, task.folder, "new", reasons=(*(before.reasons if before else ()), last))


@pytest.mark.slow
def test_a_worker_with_other_software_is_refused(address, tasks, monkeypatch):
    monkeypatch.setattr(runs, "PACKAGES", ("torch",))  # here; the workers report all of theirs
    runs.software_versions.cache_clear()
    with pytest.raises(ConfigurationError, match=r"numpy .* instead of none.*not be the same"):
        on_dask(address, deadly, tasks)
    runs.software_versions.cache_clear()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("address", "message"),
    [("tcp://127.0.0.1:9", "no Dask scheduler answers there"), ("foo", r"--scheduler foo: .*missing port")],
)
def test_an_address_without_a_scheduler_or_a_port_is_reported(tasks, monkeypatch, address, message):
    pytest.importorskip("distributed")
    monkeypatch.setattr(engines, "CONNECT_S", 0.5)
    with pytest.raises(ConfigurationError, match=message):
        on_dask(address, deadly, tasks)


@pytest.mark.slow
def test_a_killed_process_costs_only_its_own_task(tmp_path):
    tasks = [Task(name, tmp_path / name, Path("recipe.yaml")) for name in ("a", "c")]
    found = {one.name: one for one in engines.local_runner(1)(deadly, tasks)}
    assert [name for name, one in sorted(found.items()) if one.failed] == ["a"]
    assert found["c"].action == "new" and "its process was killed" in found["a"].problem


def test_without_dask_the_error_names_the_package_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    (night := tmp_path / "night").mkdir()
    options = ("--output", str(tmp_path / "tree"), "--engine", "dask", "--scheduler", "tcp://127.0.0.1:9")
    result = invoke("night", str(night), *options)
    assert result.exit_code == 2 and "pip install 'irlos-pipe[dask]'" in result.output


@pytest.mark.parametrize(
    ("address", "is_open"),
    [("10.0.0.1:8786", True), ("tls://10.0.0.1:8786", False), ("localhost:8786", False)],
)
def test_a_scheduler_that_anyone_can_use_is_warned_of(caplog, address, is_open):
    pytest.importorskip("distributed")
    engines.dask_runner(address)
    assert ("can run programs as its user" in caplog.text) == is_open
