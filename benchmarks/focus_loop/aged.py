"""Simulate a calibration and a ramp with the NCPAs as an hour's ageing has left them, and reduce them."""

from __future__ import annotations

from pathlib import Path

import click

from benchmarks.focus_loop.ageing import Ageing
from benchmarks.focus_loop.demo import calibrated
from benchmarks.focus_loop.telescope import Night, scene_of


@click.command()
@click.option("--output", type=click.Path(path_type=Path), required=True, help="Gets simulation and run.")
@click.option("--minutes", type=float, default=0.0, show_default=True, help="Since the loop began.")
@click.option("--turn-deg", type=float, default=0.0, help="By which half of the NCPAs turn in an hour.")
@click.option("--drift-nm", type=float, default=0.0, help="RMS by which the NCPAs drift in an hour.")
def main(output: Path, minutes: float, turn_deg: float, drift_nm: float) -> None:
    """Make the calibration of the instrument of `hour` when the loop has run for some MINUTES."""
    night = Night()
    scene = Ageing(turn_deg, drift_nm=drift_nm).aged(scene_of(night), minutes / 60, night.seed)
    calibrated(output, ncpa_nm=dict(scene.ncpa_nm))
    click.echo(output / "calibration")


if __name__ == "__main__":
    main()
