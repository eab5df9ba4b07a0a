"""The device, the threads and the progress bars of a run."""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from io import StringIO
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits
from tqdm import tqdm

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.files.processes import FORKS, forked_map
from irlos_pipe.pipeline.runlog import RUN, TRACE

silent_progress = partial(tqdm, disable=True)
Output = TypeVar("Output")
EVERY_S = 30  # between messages


class _Logged(tqdm):
    """Progress where there is no terminal: now and then a message with an estimate of what is left.

    Of more steps than were expected it has the number and the time.
    """

    log = RUN

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        if msg is None and 0 < self.n != self.total:
            elapsed_s, ahead = self.format_dict["elapsed"], self.total - self.n
            rest = f" of {self.total}, about {elapsed_s * ahead / self.n:.0f} s left"
            self.log.info("%s: %d%s", self.desc, self.n, rest if ahead > 0 else f" steps, {elapsed_s:.0f} s")


class _Shown(_Logged):
    """A bar on the terminal, with the same messages in run.log only."""

    log, said_s = TRACE, 0.0

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        if self.format_dict["elapsed"] > self.said_s + EVERY_S:
            self.said_s = self.format_dict["elapsed"]
            super().display(msg)
        tqdm.display(self, msg, pos)


terminal_progress = partial(_Shown, leave=False, dynamic_ncols=True)  # on stderr; disappears when it is full
logged_progress = partial(_Logged, mininterval=EVERY_S, miniters=1, file=StringIO())


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


def run_on_device(run: Callable[[str], Output], device: str) -> tuple[Output, str]:
    """Return what a function makes on a `device`, and where it did: a GPU that fails is not the end.

    Where its memory is too short the function runs again with pieces for an eighth of it, and otherwise on
    the processor.
    """
    if device == "cpu":
        return run(device), device
    import torch

    from irlos_pipe.numerics.parallel import smaller_pieces

    try:
        try:
            return run(device), device
        except torch.OutOfMemoryError:
            RUN.warning("the memory of the GPU is too short: begun again with smaller pieces")
        torch.cuda.empty_cache()
        with smaller_pieces(1 / 8):
            return run(device), device
    except RuntimeError as error:
        RUN.warning("the GPU failed (%s): begun again on the processor", str(error).splitlines()[0])
    return run("cpu"), "cpu"


@contextmanager
def limited_threads(jobs: int, *, arrays_only: bool = False) -> Iterator[None]:
    """Use `jobs` threads and processes while the block lasts; results do not depend on their number.

    NumPy and SciPy use one: sums of several differ in the last bits. Work with them alone does not wait for
    PyTorch, and has one thread.
    """
    with threadpool_limits(1, user_api="blas"), ExitStack() as stack:
        if not arrays_only:
            from irlos_pipe.numerics.parallel import workers

            stack.enter_context(workers(jobs, partial(forked_map, jobs) if FORKS else None))
        yield
