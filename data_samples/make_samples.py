"""Make the data samples: python data_samples/make_samples.py [--output DIR] [--only NAME ...] [--jobs N]."""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

from simulator.atmosphere import residual_wfe_nm
from simulator.campaign import MUSE, recorder_scenes
from simulator.exposure import record
from simulator.files import write_muse_raw, write_recorder_folder, write_truth
from simulator.pool import make_all
from simulator.scene import Scene
from simulator.telescope import build_telescope


def make_recording(scene: Scene, output: Path) -> tuple[str, float]:
    """Simulate one scene, write its files and truth below output; return its name and the seconds taken."""
    started = time.perf_counter()
    telescope = build_telescope()
    raw = record(scene, telescope)
    if scene.name == MUSE.name:
        write_muse_raw(output / f"{scene.name}.fits", scene, raw)
    else:
        write_recorder_folder(output / scene.name, scene, raw)
    residual = {"residual_wfe_nm": residual_wfe_nm(scene.seeing_arcsec)}
    write_truth(output / "truth" / f"{scene.name.replace('/', '__')}.json", scene, raw, telescope, residual)
    return scene.name, time.perf_counter() - started


def parse_arguments(scenes: list[Scene]) -> argparse.Namespace:
    """Return the command-line options; an unknown recording name ends the program with a message."""
    parser = argparse.ArgumentParser(description="Simulate the data samples with HCIPy.")
    parser.add_argument(
        "--output", type=Path, default=Path(__file__).resolve().parent, help="folder to write to"
    )
    parser.add_argument("--only", nargs="+", choices=[scene.name for scene in scenes], help="make these only")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="recordings made at the same time")
    return parser.parse_args()


def main() -> None:
    """Make all samples, or those named."""
    scenes = [*recorder_scenes(), MUSE]
    options = parse_arguments(scenes)
    wanted = [scene for scene in scenes if not options.only or scene.name in options.only]
    options.output.mkdir(parents=True, exist_ok=True)
    make_all(make_recording, wanted, options.output, options.jobs)


if __name__ == "__main__":
    main()
