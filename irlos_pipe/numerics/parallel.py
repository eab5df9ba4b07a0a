"""Worker threads for pieces of a batch.

Matrices here are small: one thread per piece of a batch keeps two cores busy where threads
inside every matrix product do not. And as each piece is computed by one thread, results are
the same to the bit for any number of workers. Who has pieces computes them as well, and waits for none that
nobody has begun: pieces of pieces keep workers busy that would else have none.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")

_pool: ContextVar[ThreadPoolExecutor | None] = ContextVar("pool", default=None)


@contextmanager
def workers(count: int) -> Iterator[None]:
    """Use `count` threads for pieces of batches while the block lasts, and one inside matrix products.

    The latter is a setting of the process, and stays. Gradients are recorded where they are asked for only.
    """
    torch.set_num_threads(1)
    # Threads begin with an empty context, and one thread inside a product is a setting of each of them.
    pool: ThreadPoolExecutor | None = None
    if count > 1:
        pool = ThreadPoolExecutor(count - 1, "irlos", lambda: _begin(pool))
    token = _pool.set(pool)
    try:
        with torch.no_grad():
            yield
    finally:
        _pool.reset(token)
        if pool is not None:
            pool.shutdown()


def _begin(pool: ThreadPoolExecutor | None) -> None:
    torch.set_num_threads(1)
    _pool.set(pool)


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
    function = torch.no_grad()(function)
    futures = [pool.submit(function, item) for item in items]
    places, own = iter(range(len(items))), {}
    try:
        for place, future in enumerate(futures):
            while not (place in own or future.done()):
                free = next((one for one in places if futures[one].cancel()), None)
                if free is None:
                    break
                own[free] = function(items[free])
            yield own.pop(place) if place in own else future.result()
    finally:
        for future in futures:
            future.cancel()
