"""Worker threads for pieces of a batch.

Matrices here are small: one thread per piece of a batch keeps two cores busy where threads
inside every matrix product do not. And as each piece is computed by one thread, results are
the same to the bit for any number of workers.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")

_inside = threading.local()
_pool: ThreadPoolExecutor | None = None


def set_workers(count: int) -> None:
    """Use `count` threads for pieces of batches, and one inside every matrix product.

    Like `torch.set_num_threads`, which it calls, this is a setting of the process.
    """
    global _pool
    torch.set_num_threads(1)
    if _pool is not None:
        _pool.shutdown()
    # The number of threads inside a product is one of each thread as well as of the process.
    _pool = ThreadPoolExecutor(count, "irlos", torch.set_num_threads, (1,)) if count > 1 else None


def ordered_map(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Results of `function` for every item, in order; side by side if there are workers.

    Called from a worker, it runs in that worker: pieces of pieces do not wait for each other.
    Where gradients are recorded it runs in the caller's thread: the transforms of `torch.func`
    do not follow into others, and would return zeros.
    """
    return list(_results(function, list(items)))


def joined_map(
    function: Callable[[Item], tuple[torch.Tensor, ...]], pieces: Iterable[Item], members: int
) -> tuple[torch.Tensor, ...]:
    """Results of `function` for the pieces of a batch of so many members, put together along the first axis.

    As `ordered_map`, but every result is copied to its place as soon as it is there: kept until the end,
    thousands of small ones would lie between pieces of freed memory, which then stay unused.
    """
    results = _results(function, list(pieces))
    if torch.is_grad_enabled():
        return tuple(map(torch.cat, zip(*results, strict=True)))
    wholes, done = (), 0
    for parts in results:
        wholes = wholes or tuple(part.new_empty(members, *part.shape[1:]) for part in parts)
        for whole, part in zip(wholes, parts, strict=True):
            whole[done : done + len(part)] = part
        done += len(parts[0])
    return wholes


def _results(function: Callable[[Item], Result], items: list[Item]) -> Iterator[Result]:
    alone = _pool is None or len(items) < 2 or getattr(_inside, "worker", False)
    if alone or torch.is_grad_enabled():
        return map(function, items)
    return _pool.map(_marked(function), items)


def _marked(function: Callable[[Item], Result]) -> Callable[[Item], Result]:
    """`function`, in a thread that knows it is a worker."""

    def run(item: Item) -> Result:
        _inside.worker = True
        with torch.no_grad():
            return function(item)

    return run
