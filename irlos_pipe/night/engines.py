"""Where tasks are worked on: in processes of this machine, or in the workers of a Dask cluster.

On a cluster every stage of a task is one Dask task. The stages are chained, so that a worker that dies
costs the stage it was working on, and the scheduler gives that stage to another worker. Workers need the
same software and the same paths. A process or worker that dies takes other tasks with it; these are tried
again, each by itself, so that only the one at fault is lost.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from typing import TYPE_CHECKING, Any

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError
from irlos_pipe.files.processes import in_processes
from irlos_pipe.night.reduce import Reduced, Runner, Task, Work, failure
from irlos_pipe.pipeline.run import software_versions
from irlos_pipe.pipeline.runlog import RUN

if TYPE_CHECKING:
    from distributed import Client, Future

KILLED = "its process was killed: memory ran out (try fewer --jobs), or it hung beyond its --limit"
CONNECT_S = 30  # for a scheduler to answer
WORKERS_S = 600  # a batch system may need this long to start the first
IN_FLIGHT = 2000  # tasks known to the scheduler at a time, which bounds its memory
_one_at_a_time = threading.Lock()


def local_runner(jobs: int) -> Runner:
    """Return a runner of up to `jobs` processes of one thread each."""

    def run(work: Work, tasks: Sequence[Task]) -> Iterator[Reduced]:
        lost = list(tasks)
        for reduced in _in_processes(work, tasks, jobs):
            lost = [task for task in lost if task.name != reduced.name]
            yield reduced
        for task in lost:
            yield next(_in_processes(work, [task], 1), failure(task, KILLED))

    return run


def _in_processes(work: Work, tasks: Sequence[Task], jobs: int) -> Iterator[Reduced]:
    """Yield the outcomes as they are ready, until a process dies."""
    if not tasks:
        return
    with in_processes(min(jobs, len(tasks)), work, [(task,) for task in tasks]) as futures:
        for future in as_completed(futures):
            if isinstance(future.exception(), BrokenProcessPool):
                return
            yield future.result()


def dask_runner(scheduler: str) -> Runner:
    """Return a runner on the cluster of a `scheduler`, an address such as ``tls://10.0.0.1:8786``.

    Certificates stand in Dask's own configuration. Raises `ConfigurationError` when Dask is not installed;
    when the runner starts, also if no scheduler answers at the address or a worker has other software, and
    `IrlosError` when no worker joins the cluster.
    """
    _distributed()
    # private: within this process, this machine, or with certificates
    scheme, _, location = scheduler.rpartition("://")
    host = location.rpartition(":")[0].strip("[]")
    if not (scheme in ("tls", "inproc") or host in ("localhost", "::1") or host.startswith("127.")):
        RUN.warning(
            "--scheduler %s: whoever reaches it can run programs as its user; use tls:// (docs/scale_out.md)",
            scheduler,
        )

    def run(work: Work, tasks: Sequence[Task]) -> Iterator[Reduced]:
        with _connected(scheduler) as client:
            lost = []
            for future, task in _futures(client, work, tasks, IN_FLIGHT):
                # Dask blames the death of a worker on all tasks it held
                if isinstance(future.exception(), _distributed().scheduler.KilledWorker):
                    lost.append(task)
                else:
                    yield _outcome(future, task)
            for future, task in _futures(client, work, lost, 1):
                yield _outcome(future, task)

    return run


def _futures(
    client: Client, work: Work, tasks: Sequence[Task], in_flight: int
) -> Iterator[tuple[Future[Reduced], Task]]:
    """Yield the last stage of every task as it ends; at most `in_flight` tasks are under way at a time."""
    waiting = iter(tasks)
    owners: dict[str, Task] = {}

    def submitted(count: int) -> list[Future[Reduced]]:
        chains = [(_chain(client, work, task), task) for task in islice(waiting, count)]
        owners.update((str(future.key), task) for future, task in chains)
        return [future for future, _ in chains]

    done = _distributed().as_completed(submitted(in_flight), loop=client.loop)
    for future in done:
        yield future, owners.pop(str(future.key))
        done.update(submitted(1))


def _chain(client: Client, work: Work, task: Task) -> Future[Reduced]:
    """Submit the stages of a task, each waiting for the one before; return the last."""
    future: Any = None
    for stage in task.load().stages:
        key = f"{task.name}/{stage}"
        future = client.submit(_stage, work, task, stage, future, key=key, pure=False)
    return future


def _stage(work: Work, task: Task, stage: str, before: Reduced | None) -> Reduced:
    """Work on one stage at a time: threads and logs belong to the process."""
    with _one_at_a_time:
        return work(task, stage, before)


def _outcome(future: Future[Reduced], task: Task) -> Reduced:
    error = future.exception()
    if error is None:
        return future.result()
    reason = next(iter(str(error).splitlines()), "")
    return failure(task, f"lost on the cluster: {type(error).__name__}: {reason}")


@contextmanager
def _connected(scheduler: str) -> Iterator[Client]:
    """Connect to a cluster that has a worker; all workers have the software of this process."""
    distributed = _distributed()
    try:
        scheme, location = distributed.comm.parse_address(scheduler)
        if scheme in ("tcp", "tls"):  # a client would miss the port only when it is deleted
            distributed.comm.parse_host_port(location)
        client = distributed.Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, TypeError, ValueError) as error:  # a timeout is an OSError, no certificate a TypeError
        raise ConfigurationError(
            f"--scheduler {scheduler}: no Dask scheduler answers there "
            f"({next(iter(str(error).splitlines()), type(error).__name__)})"
        ) from error
    with client:
        _require_workers(client, scheduler)
        yield client


def _require_workers(client: Client, scheduler: str) -> None:
    if not client.scheduler_info()["workers"]:
        RUN.info("waiting for workers at %s", scheduler)
    try:
        client.wait_for_workers(1, timeout=WORKERS_S)
    except TimeoutError:
        raise IrlosError(
            f"--scheduler {scheduler}: no worker within {WORKERS_S // 60} minutes; "
            f"start some with: dask worker {scheduler} --nthreads 1"
        ) from None
    own = software_versions()
    for address, versions in client.run(software_versions).items():
        if versions != own:
            different = (
                f"{name} {versions.get(name, 'missing')} instead of {own.get(name, 'none')}"
                for name in own | versions
                if versions.get(name) != own.get(name)
            )
            raise ConfigurationError(
                f"worker {address}: {', '.join(different)}; "
                "results would not be the same: install the same versions"
            )


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise ConfigurationError(
            "--engine dask: Dask is not installed; pip install 'irlos-pipe[dask]'"
        ) from None
    return distributed
