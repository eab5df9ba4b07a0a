"""The device, the threads and the progress bars of a run."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from io import StringIO
from typing import Any

from threadpoolctl import threadpool_limits
from tqdm import tqdm

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.pipeline.runlog import RUN

silent_progress = partial(tqdm, disable=True)
terminal_progress = partial(tqdm, leave=False, dynamic_ncols=True)  # on stderr; disappears when it is full


class _Logged(tqdm):
    """Progress where there is no terminal: now and then a message with an estimate of what is left."""

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        if msg is None and 0 < self.n < self.total:
            left_s = self.format_dict["elapsed"] * (self.total - self.n) / self.n
            RUN.info("%s: %d of %d, about %.0f s left", self.desc, self.n, self.total, left_s)


logged_progress = partial(_Logged, mininterval=30, miniters=1, file=StringIO())


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
