"""Time and memory of one case, each in a process of its own."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "AOCORE_FFT_WORKERS",
    "AOCORE_BLAS_THREADS",
)
MIB = 2**20


@dataclass
class Stopwatch:
    """Wall-clock and processor time of a block [s]; all threads count in the latter."""

    wall_s: float = 0.0
    cpu_s: float = 0.0

    def over(self, frames: int) -> dict:
        """Part of a case's outcome: the times, and the number of frames they were taken over."""
        return {"frames": frames, "wall_s": self.wall_s, "cpu_s": self.cpu_s}


@contextmanager
def stopwatch():
    """Time a block; the yielded `Stopwatch` is set when the block ends."""
    watch = Stopwatch()
    wall, cpu = time.perf_counter(), time.process_time()
    yield watch
    watch.wall_s, watch.cpu_s = time.perf_counter() - wall, time.process_time() - cpu


def peak_mib() -> float:
    """Largest resident size of this process so far [MiB]."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / MIB


def in_own_process(case: str, folder: Path, frames: int, threads: int) -> dict:
    """Run one case (see `cases`) in a fresh interpreter.

    Libraries get one thread each; `threads` is the number of workers of irlos_pipe.

    Raises
    ------
    SystemExit
        With the last line of its messages, if it fails.
    """
    environment = os.environ | dict.fromkeys(THREAD_VARIABLES, "1")
    command = [sys.executable, "-m", "benchmarks.cases", case, str(folder), str(frames), str(threads)]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, cwd=Path(__file__).parents[1]
    )
    if done.returncode != 0:
        raise SystemExit(
            f"benchmark {case} failed: {(done.stderr.strip().splitlines() or ['no message'])[-1]}"
        )
    return json.loads(done.stdout.splitlines()[-1]) | {"case": case, "threads": threads}
