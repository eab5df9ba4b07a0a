"""Worker processes of one thread each, which never outlive the process that uses them."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, get_context, parent_process

from tqdm import tqdm

# What the numerical libraries look at when they are loaded.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@contextmanager
def in_processes(count: int, function: Callable, arguments: Iterable[tuple]) -> Iterator[list[Future]]:
    """Call `function` with every tuple of `arguments` in up to `count` processes.

    The processes start from nothing ("spawn"), so that results do not depend on the state of this
    one, and leave Ctrl-C to it. They are killed when the block is left by an exception.
    """
    pool = ProcessPoolExecutor(count, get_context("spawn"), initializer=_begin)
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


def _begin() -> None:
    """What a worker does first."""
    tqdm.set_lock(threading.RLock())  # its own, one between processes, is left behind by one that is killed

    def watch() -> None:  # a parent that is killed cannot end its workers
        parent = parent_process()
        if parent is not None:
            parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
