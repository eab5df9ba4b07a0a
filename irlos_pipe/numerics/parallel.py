"""Worker processes for much work of which little comes out, and worker threads for pieces of a batch.

Matrices here are small: one worker per piece keeps two cores busy where threads inside every matrix product
do not. And as each piece is computed by one thread, results are the same to the bit for any number of
workers. Between two products the interpreter has its turn: threads wait for each other there, processes do
not. What makes these is for the caller to say: science knows no system.

Who has pieces for threads computes them as well, and waits for none that nobody has begun: pieces of pieces
keep workers busy that would else have none.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Any, TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")
# Returns what a function makes of items, in order, from processes that know all that the caller knows; calls
# the third argument with each that is done, the fourth in every process first, and the last here meanwhile.
ForkedMap = Callable[[Callable, list, Callable, Callable[[], None], Callable[[], Any] | None], list]

PROCESSOR_BYTES = 2**29  # memory that a piece for a processor takes, at most; those for a GPU fill its own

_pool: ContextVar[ThreadPoolExecutor | None] = ContextVar("pool", default=None)
_forked: ContextVar[ForkedMap | None] = ContextVar("forked", default=None)


@contextmanager
def workers(count: int, forked_map: ForkedMap | None = None) -> Iterator[None]:
    """Use `count` threads, and processes of a `forked_map`, while the block lasts.

    Inside matrix products there is one thread; this is a setting of the process, and stays. Gradients are
    recorded where they are asked for only.
    """
    torch.set_num_threads(1)
    # Threads begin with an empty context, and one thread inside a product is a setting of each of them.
    pool: ThreadPoolExecutor | None = None
    if count > 1:
        pool = ThreadPoolExecutor(count - 1, "irlos", lambda: _begin(pool))
    tokens = _pool.set(pool), _forked.set(forked_map)
    try:
        with torch.no_grad():
            yield
    finally:
        _pool.reset(tokens[0])
        _forked.reset(tokens[1])
        if pool is not None:
            pool.shutdown()


def _begin(pool: ThreadPoolExecutor | None) -> None:
    torch.set_num_threads(1)
    _pool.set(pool)


def process_map(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    report: Callable[[Item], Any] = lambda item: None,
    meanwhile: Callable[[], Any] | None = None,
) -> list[Result]:
    """Return what `function` makes of all `items`, in order, from processes; `report` gets each that is done.

    There are none beside threads, whose locks a fork would keep, within processes, nor where gradients are
    recorded; then there are threads. A GPU in use does not survive a fork, and needs one thread only. What is
    called `meanwhile`, here while the processes work, has threads only.
    """
    forked_map, items = _forked.get(), list(items)
    on_gpu = torch.cuda.is_initialized()
    several = len(items) + (meanwhile is not None) > 1
    if forked_map and several and not (torch.is_grad_enabled() or on_gpu):
        token = _forked.set(None)
        try:
            return forked_map(function, items, report, _begin_process, meanwhile)
        finally:
            _forked.reset(token)
    if meanwhile is not None:
        meanwhile()
    results = []
    for item, result in zip(items, (map if on_gpu else _results)(function, items), strict=True):
        results.append(result)
        report(item)
    return results


def _begin_process() -> None:
    torch.set_grad_enabled(False)
    _pool.set(None)
    _forked.set(None)


def at_once(count: int, device: str) -> int:
    """Return how many members make a piece on a `device`, of which a processor takes `count`."""
    return count if device == "cpu" else max(1, int(count * _gpu_bytes() / PROCESSOR_BYTES * _share))


@cache
def _gpu_bytes() -> int:
    return torch.cuda.get_device_properties("cuda").total_memory


_share = 1.0  # part of the memory of a GPU that pieces are made for; the same in all threads


@contextmanager
def smaller_pieces(share: float) -> Iterator[None]:
    """Make pieces for a `share` of the memory of a GPU while the block lasts."""
    global _share
    _share, before = share, _share
    try:
        yield
    finally:
        _share = before


def ordered_map(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return what `function` makes of all `items`, in order; side by side if there are workers.

    Where gradients are recorded it runs in the caller's thread: workers do not record any.
    """
    return list(_results(function, list(items)))


def joined_map(
    function: Callable[[Item], tuple[torch.Tensor, ...]], pieces: Iterable[Item], members: int
) -> tuple[torch.Tensor, ...]:
    """Return what `function` makes of the `pieces` of a batch of `members`, joined along the first axis.

    As `ordered_map`, but every result is copied to its place as soon as it is there: kept until the end,
    thousands of small ones would lie between pieces of freed memory, which then stay unused.
    """
    results = _results(function, list(pieces))
    if torch.is_grad_enabled():
        return tuple(map(torch.cat, zip(*results, strict=True)))
    wholes: tuple[torch.Tensor, ...] = ()
    done = 0
    for parts in results:
        wholes = wholes or tuple(part.new_empty(members, *part.shape[1:]) for part in parts)
        for whole, part in zip(wholes, parts, strict=True):
            whole[done : done + len(part)] = part
        done += len(parts[0])
    return wholes


def _results(function: Callable[[Item], Result], items: list[Item]) -> Iterator[Result]:
    pool = _pool.get()
    if pool is None or len(items) < 2 or torch.is_grad_enabled():
        yield from map(function, items)
        return

    @torch.no_grad()
    def piece(item: Item) -> Result:
        token = _forked.set(None)
        try:
            return function(item)
        finally:
            _forked.reset(token)

    futures = [pool.submit(piece, item) for item in items]
    places, own = iter(range(len(items))), {}
    try:
        for place, future in enumerate(futures):
            while not (place in own or future.done()):
                free = next((one for one in places if futures[one].cancel()), None)
                if free is None:
                    break
                own[free] = piece(items[free])
            yield own.pop(place) if place in own else future.result()
    finally:
        for future in futures:
            future.cancel()
