"""Make recordings behind an adaptive optics that is simulated end to end, below --output DIR."""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

from simulator.closed_loop import ClosedLoop
from simulator.end_to_end import SEED, scenes
from simulator.exposure import record
from simulator.files import write_recorder_folder, write_truth
from simulator.pool import make_all
from simulator.scene import Scene
from simulator.telescope import build_telescope


def make_recording(scene: Scene, output: Path) -> tuple[str, float]:
    """Simulate one scene, write its files and truth; return its name and the seconds taken."""
    started = time.perf_counter()
    seeing, _, name = scene.name.partition("/")
    telescope = build_telescope()
    raw = record(scene, telescope, ClosedLoop)
    write_recorder_folder(output / seeing / "data" / name, scene, raw)
    write_truth(output / seeing / "truth" / f"{name.replace('/', '__')}.json", scene, raw, telescope, {})
    return scene.name, time.perf_counter() - started


def main() -> None:
    """Make all recordings: 16 minutes of processor time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True, help="folder to write to")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="recordings made at the same time")
    parser.add_argument("--seed", type=int, default=SEED, help="of turbulence, noise and NCPAs")
    options = parser.parse_args()
    make_all(make_recording, scenes(options.seed), options.output, options.jobs)


if __name__ == "__main__":
    main()
