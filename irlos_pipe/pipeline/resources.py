"""The device, the threads and the progress bars of a run."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

from threadpoolctl import threadpool_limits
from tqdm import tqdm

from irlos_pipe.conventions.errors import ConfigurationError

silent_progress = partial(tqdm, disable=True)
LINE_S = 30.0  # between two lines of progress where there is no terminal


class _WholeLines:
    """Takes a progress bar where there is no terminal: what it draws in place becomes a line of its own."""

    def write(self, text: str) -> None:
        if text := text.strip():
            with suppress(OSError, ValueError):  # nobody listens any more
                print(f"irlos: {text}", file=sys.stderr, flush=True)

    def flush(self) -> None:
        pass


line_progress = partial(
    tqdm,
    file=_WholeLines(),
    leave=False,
    delay=LINE_S,
    mininterval=LINE_S,
    maxinterval=LINE_S,
    bar_format="{desc}: {n_fmt} of {total_fmt}, {elapsed} so far, {remaining} to go",
)
terminal_progress = partial(tqdm, leave=False, dynamic_ncols=True)  # on stderr; disappears when it is full


@dataclass(frozen=True)
class Resources:
    """What a run may use."""

    # ``cpu``, ``cuda`` or ``auto``, which is resolved when a stage runs: PyTorch takes long to load.
    device: str = "cpu"
    jobs: int = 1  # number of threads or processes
    progress: Callable[..., Any] = silent_progress  # makes progress bars, see `StageContext`
    report: bool = True  # whether the report is built


def available_cpus() -> int:
    """Number of processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def resolve_device(wanted: str) -> str:
    """Return ``cpu`` or ``cuda`` for ``auto``, ``cpu`` or ``cuda``.

    Raises `ConfigurationError` when ``cuda`` is requested and there is none.
    """
    if wanted == "cpu":
        return wanted
    import torch

    if torch.cuda.is_available():
        # PyTorch loads a GPU's linear algebra on first use, and fails where two threads do so at once.
        torch.linalg.inv(torch.eye(1, device="cuda"))
        return "cuda"
    if wanted == "cuda":
        raise ConfigurationError(
            "--device cuda: PyTorch finds no CUDA device; use --device cpu, "
            "or install a CUDA build of PyTorch (make env TORCH_INDEX=...)"
        )
    return "cpu"


@contextmanager
def limited_threads(jobs: int) -> Iterator[None]:
    """Use `jobs` threads while the block lasts; results do not depend on their number.

    NumPy and SciPy use one: sums of several differ in the last bits.
    """
    from irlos_pipe.numerics.parallel import workers

    with workers(jobs), threadpool_limits(1, user_api="blas"):
        yield
