"""Recordings simulated and written, by several processes."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

from simulator.atmosphere import ResidualScreens
from simulator.campaign import MUSE, Scene
from simulator.exposure import Residual, record
from simulator.files import write_muse_raw, write_recorder_folder, write_truth
from simulator.telescope import build_telescope


def make(
    scene: Scene, data: Path, truth: Path, name: str, known: dict, residual: Residual = ResidualScreens
) -> tuple[str, float]:
    """Simulate a scene, write its files at `data` and its truth, which takes the `name`, below `truth`.

    What is `known` of the AO residual stands in the truth. Returns the scene's name and the seconds taken.
    """
    started = time.perf_counter()
    telescope = build_telescope()
    raw = record(scene, telescope, residual)
    if scene.name == MUSE.name:
        write_muse_raw(data.with_name(f"{data.name}.fits"), scene, raw)
    else:
        write_recorder_folder(data, scene, raw)
    write_truth(truth / f"{name.replace('/', '__')}.json", scene, raw, telescope, known)
    return scene.name, time.perf_counter() - started


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
