"""Work on tasks in processes of this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool

from irlos_pipe.files.processes import in_processes
from irlos_pipe.night.reduce import Reduced, Runner, Task, failure

KILLED = "its process was killed, perhaps for want of memory; run again, with fewer --jobs"


def local_runner(jobs: int) -> Runner:
    """Return a runner of up to `jobs` processes of one thread each.

    A process that dies takes the others with it. What they worked on is then tried again, each task
    by itself, so that only the one at fault is lost.
    """

    def run(work: Callable[[Task], Reduced], tasks: Sequence[Task]) -> Iterator[Reduced]:
        lost = list(tasks)
        for done in _together(work, tasks, jobs):
            lost = [task for task in lost if task.name != done.name]
            yield done
        for task in lost:
            yield next(_together(work, [task], 1), failure(task, KILLED))

    return run


def _together(work: Callable[[Task], Reduced], tasks: Sequence[Task], jobs: int) -> Iterator[Reduced]:
    """Yield the results as they come, until a process dies."""
    if not tasks:
        return
    with in_processes(min(jobs, len(tasks)), work, [(task,) for task in tasks]) as futures:
        for future in as_completed(futures):
            if isinstance(future.exception(), BrokenProcessPool):
                return
            yield future.result()
