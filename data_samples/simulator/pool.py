"""Recordings made by several processes."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from simulator.scene import Scene


def make_all(
    make: Callable[[Scene, Path], tuple[str, float]], scenes: Sequence[Scene], output: Path, jobs: int | None
) -> None:
    """Let `jobs` processes `make` all scenes below `output`; print each name and the seconds taken."""
    # The recordings share the cores; threads inside a worker would only compete. Spawned workers see this.
    os.environ["OMP_NUM_THREADS"] = "1"
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for done in as_completed([pool.submit(make, scene, output) for scene in scenes]):
            name, seconds = done.result()
            print(f"{name}: {seconds:.0f} s", flush=True)
