"""Work on tasks in the workers of a Dask cluster: one Dask task per recording and stage.

The stages of a task are chained, so that a worker that dies costs the stage it was at, and the
scheduler hands that to another. Workers need the same software and see the same paths.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from typing import TYPE_CHECKING, Any

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError
from irlos_pipe.night.reduce import Reduced, Runner, Task, failure
from irlos_pipe.pipeline.provenance import software_versions
from irlos_pipe.pipeline.runlog import RUN

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT_S = 30
WORKERS_S = 600  # a batch system may need this long to start the first
IN_FLIGHT = 2000  # chains the scheduler knows of at a time, which bounds its memory
_one_at_a_time = threading.Lock()


def dask_runner(scheduler: str) -> Runner:
    """Return a runner on an existing cluster.

    Parameters
    ----------
    scheduler : str
        Address such as ``tcp://10.0.0.1:8786``.

    Raises
    ------
    ConfigurationError
        When Dask is not installed, or, as the runner begins, nobody answers at the address or a
        worker has other software.
    IrlosError
        When no worker joins the cluster.
    """
    _distributed()

    def run(work: Callable[..., Reduced], tasks: Sequence[Task]) -> Iterator[Reduced]:
        with _connected(scheduler) as client:
            yield from _all_done(client, work, tasks)

    return run


def _all_done(client: Client, work: Callable[..., Reduced], tasks: Sequence[Task]) -> Iterator[Reduced]:
    """Yield what became of the tasks, as they come.

    Dask blames a worker's death on all that waited there. What it gives up is tried again, each task
    by itself, so that only the one at fault is lost.
    """
    given_up = []
    for future, task in _as_completed(client, work, tasks, IN_FLIGHT):
        if isinstance(future.exception(), _distributed().scheduler.KilledWorker):
            given_up.append(task)
        else:
            yield _outcome(future, task)
    for future, task in _as_completed(client, work, given_up, 1):
        yield _outcome(future, task)


def _as_completed(
    client: Client, work: Callable[..., Reduced], tasks: Sequence[Task], in_flight: int
) -> Iterator[tuple[Future, Task]]:
    """Yield the last stages of the tasks as they end, no more than so many tasks under way at a time."""
    waiting, owners = iter(tasks), {}

    def submitted(count: int) -> list[Future]:
        chains = {_chain(client, work, task): task for task in islice(waiting, count)}
        owners.update((future.key, task) for future, task in chains.items())
        return list(chains)

    done = _distributed().as_completed(submitted(in_flight), loop=client.loop)
    for future in done:
        yield future, owners.pop(future.key)
        done.update(submitted(1))


def _chain(client: Client, work: Callable[..., Reduced], task: Task) -> Future | None:
    """Submit the stages of a task, each waiting for the one before; returns the last."""
    before = None
    for stage in task.load().stages:
        before = client.submit(_stage, work, task, stage, before, key=f"{task.name}/{stage}", pure=False)
    return before


def _stage(work: Callable[..., Reduced], task: Task, stage: str, before: Reduced | None) -> Reduced:
    """Work on one stage, alone in its process: threads and logs belong to the process."""
    with _one_at_a_time:
        return work(task, stage, before)


def _outcome(future: Future, task: Task) -> Reduced:
    error = future.exception()
    if error is None:
        return future.result()
    reason = next(iter(str(error).splitlines()), "")
    return failure(task, f"lost on the cluster: {type(error).__name__}: {reason}")


@contextmanager
def _connected(scheduler: str) -> Iterator[Client]:
    """A client of a cluster that has a worker, all with the software of this process."""
    try:
        _require_port(scheduler)
        client = _distributed().Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:  # a timeout is an OSError
        raise ConfigurationError(
            f"--scheduler {scheduler}: no Dask scheduler answers there "
            f"({next(iter(str(error).splitlines()), type(error).__name__)})"
        ) from error
    with client:
        _require_workers(client, scheduler)
        yield client


def _require_port(scheduler: str) -> None:
    """Raise ValueError for an address without one; the client would, and once more when it is deleted."""
    scheme, place = _distributed().comm.parse_address(scheduler)
    if scheme in ("tcp", "tls"):
        _distributed().comm.parse_host_port(place)


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
    _require_same_software(client)


def _require_same_software(client: Client) -> None:
    own = software_versions()
    for address, versions in client.run(software_versions).items():
        if versions != own:
            raise ConfigurationError(
                f"worker {address}: {_difference(versions, own)}; "
                "results would not be the same: install the same versions"
            )


def _difference(theirs: dict[str, str], own: dict[str, str]) -> str:
    return ", ".join(
        f"{name} {theirs.get(name, 'missing')} instead of {own.get(name, 'none')}"
        for name in own | theirs
        if theirs.get(name) != own.get(name)
    )


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise ConfigurationError(
            "--engine dask: Dask is not installed; pip install 'irlos-pipe[dask]'"
        ) from None
    return distributed
