"""Make recordings behind an adaptive optics that is simulated end to end, below --output DIR."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from simulator.campaign import END_TO_END_SEED, Scene, end_to_end_scenes
from simulator.closed_loop import ClosedLoop
from simulator.making import make, make_all


def make_recording(scene: Scene, output: Path) -> tuple[str, float]:
    """Simulate one scene, write its files and truth; return its name and the seconds taken."""
    seeing, _, name = scene.name.partition("/")
    return make(scene, output / seeing / "data" / name, output / seeing / "truth", name, {}, ClosedLoop)


def main() -> None:
    """Make all recordings: 16 minutes of processor time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True, help="folder to write to")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="recordings made at the same time")
    parser.add_argument("--seed", type=int, default=END_TO_END_SEED, help="of turbulence, noise and NCPAs")
    options = parser.parse_args()
    make_all(make_recording, end_to_end_scenes(options.seed), options.output, options.jobs)


if __name__ == "__main__":
    main()
