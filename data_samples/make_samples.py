"""Make the data samples: python data_samples/make_samples.py [--output DIR] [--only NAME ...] [--jobs N]."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from simulator.atmosphere import residual_wfe_nm
from simulator.campaign import Scene, sample_scenes
from simulator.making import make, make_all


def make_recording(scene: Scene, output: Path) -> tuple[str, float]:
    """Simulate one scene, write its files and truth below output; return its name and the seconds taken."""
    residual = {"residual_wfe_nm": residual_wfe_nm(scene.seeing_arcsec)}
    return make(scene, output / scene.name, output / "truth", scene.name, residual)


def main() -> None:
    """Make all samples, or those named; an unknown name ends the program with a message."""
    scenes = sample_scenes()
    parser = argparse.ArgumentParser(description="Simulate the data samples with HCIPy.")
    parser.add_argument(
        "--output", type=Path, default=Path(__file__).resolve().parent, help="folder to write to"
    )
    parser.add_argument("--only", nargs="+", choices=[scene.name for scene in scenes], help="make these only")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="recordings made at the same time")
    options = parser.parse_args()
    wanted = [scene for scene in scenes if not options.only or scene.name in options.only]
    options.output.mkdir(parents=True, exist_ok=True)
    make_all(make_recording, wanted, options.output, options.jobs)


if __name__ == "__main__":
    main()
