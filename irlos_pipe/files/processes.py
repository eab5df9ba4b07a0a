"""Worker processes of one thread each, which never outlive the process that uses them."""

import logging
import os
import pickle
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from contextvars import ContextVar
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from types import FrameType
from typing import Any, Literal, TypeVar

from tqdm import tqdm

from irlos_pipe.conventions.errors import IrlosError

GRACE_S = 30.0  # how much later a process of our own is killed that does not even hear of it
GB = 1e9
LOG = logging.getLogger("irlos_pipe.run")
FORKS = sys.platform == "linux"  # elsewhere libraries do not survive a fork

Item = TypeVar("Item")
Result = TypeVar("Result")
_work: ContextVar[tuple[Callable, list]] = ContextVar("work")

# What the numerical libraries look at when they are loaded.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def ignored(*_: Any) -> None:
    """Do nothing: for callers that do not want to hear of something."""


class TookTooLong(BaseException):
    """Something took longer than it may; no `except Exception` on the way takes it for its own problem."""


@contextmanager
def time_limit(seconds: float, what: str, *, kill: bool = False) -> Iterator[None]:
    """Raise TookTooLong, with a message that begins with `what`, after so many `seconds`; never if 0.

    An alarm of the system interrupts the block, reads and waits included. Python hears of it between two of
    its own steps: what hangs inside a library, or in a disk that does not answer, can only be killed with its
    process. With `kill` this process, a worker, is, if it has not ended half a minute later. Alarms belong to
    the main thread; elsewhere there is no limit.
    """
    if seconds <= 0 or threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise TookTooLong(f"{what}: took longer than {seconds / 60:.3g} min and was stopped")

    before = signal.signal(signal.SIGALRM, stop)
    killer = threading.Timer(seconds + GRACE_S, os.kill, (os.getpid(), signal.SIGKILL))
    killer.daemon = True
    if kill:
        killer.start()
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        killer.cancel()


def require_memory(needed_bytes: float, what: str, error: type[IrlosError], advice: str) -> None:
    """Raise an `error`, from `what` to `advice`, when less memory than `needed_bytes` is free."""
    free = available_bytes()
    if needed_bytes > free:
        raise error(
            f"{what}: needs about {needed_bytes / GB:.1f} GB of memory, {free / GB:.1f} are free; {advice}"
        )


def available_bytes() -> float:
    """Return the memory [bytes] that a new program can have without swapping; infinite if not known."""
    try:
        found = re.search(r"MemAvailable: +([0-9]+) kB", Path("/proc/meminfo").read_text())
        if found:
            return 1024.0 * int(found[1])
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (OSError, ValueError):
        return float("inf")


@contextmanager
def in_processes(
    count: int,
    function: Callable,
    arguments: Iterable[tuple],
    start: Literal["spawn", "fork"] = "spawn",
    begin: Callable[[], None] = ignored,
) -> Iterator[list[Future]]:
    """Call `function` with every tuple of `arguments` in up to `count` processes.

    The processes `start` from nothing ("spawn"), so that results do not depend on the state of this one, or
    from all that it knows ("fork"), at once, and `begin` there. They leave Ctrl-C to this one, and are killed
    when the block is left by an exception.
    """
    pool = ProcessPoolExecutor(count, get_context(start), initializer=_begin, initargs=(begin,))
    others = active_children()
    with _one_thread_each(), _unreached_by_interrupts():
        futures = [pool.submit(function, *one) for one in arguments]  # starts the processes
    workers = [child for child in active_children() if child not in others]
    try:
        yield futures
    except BaseException:
        for worker in workers:
            worker.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes started in this block use one thread, and so give the same sums to the bit."""
    before = dict(os.environ)
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name in ONE_THREAD:
            if name in before:
                os.environ[name] = before[name]
            else:
                del os.environ[name]


@contextmanager
def _unreached_by_interrupts() -> Iterator[None]:
    """Processes started in this block inherit that SIGINT is blocked; here it waits for the end."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(begin: Callable[[], None]) -> None:
    """What a worker does first."""
    tqdm.set_lock(threading.RLock())  # its own, one between processes, is left behind by one that is killed

    def watch() -> None:  # a parent that is killed cannot end its workers
        parent = parent_process()
        if parent is not None:
            parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    begin()


def forked_map(
    count: int,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    report: Callable[[Item], Any] = ignored,
    begin: Callable[[], None] = ignored,
    meanwhile: Callable[[], Any] | None = None,
) -> list[Result]:
    """Return what `function` makes of all `items`, in order, with up to `count` processes of one thread each.

    They are forked, know all that the caller knows, and send back results only; they take some hundredths of
    a second to start. `report` gets each item that is done; `meanwhile` is called here while they work. What
    is left where a system does not fork, or when a process was killed, is done here.
    """
    items, results = list(items), {}
    here = ignored if meanwhile is None else meanwhile
    if count == 1 or not FORKS or len(items) + (meanwhile is not None) < 2:
        here()
    else:
        token, tasks = _work.set((function, items)), [(place,) for place in range(len(items))]
        try:
            with in_processes(min(count, len(items)), _worked, tasks, "fork", begin) as futures:
                here()
                places = {future: place for place, future in enumerate(futures)}
                for future in as_completed(futures):
                    results[places[future]] = pickle.loads(future.result())
                    report(items[places[future]])
        except BrokenProcessPool:
            LOG.warning("a worker process was killed, perhaps because memory ran out; its work is done again")
        finally:
            _work.reset(token)
    for place, item in enumerate(items):
        if place not in results:
            results[place] = function(item)
            report(item)
    return [results[place] for place in range(len(items))]


def _worked(place: int) -> bytes:
    """The result of an item; PyTorch's tensors by themselves would travel as files, which are few."""
    function, items = _work.get()
    return pickle.dumps(function(items[place]))
