"""Two minutes of the focus loop: calibration, telescope, loop, page, and the residual that is left."""

from __future__ import annotations

import json
import subprocess
import sys
import webbrowser
from collections.abc import Mapping
from pathlib import Path

import click

from benchmarks.focus_loop.run import Outcome, Trial
from benchmarks.focus_loop.telescope import Night

RECORDINGS = ["--set", "recordings.calibration.frames=100", "--set", "recordings.ramp.frames=2"]
OPTIONS = ["--page-port", "0", "--despite-qc"]  # QC may fail: the calibration has only 100 frames
EXPOSURES_A_LINE = 30  # where there is no terminal
SETTLED = 20  # exposures after the loop has closed that do not count


@click.command()
@click.option(
    "--output", type=click.Path(path_type=Path), required=True, help="A folder, which keeps a calibration."
)
@click.option("--exposures", type=int, default=120, show_default=True, help="Of a second.")
@click.option("--speed", type=float, default=1.0, show_default=True, help="Times real time; 0 does not wait.")
@click.option("--mag-j", type=float, default=12.0, show_default=True)
@click.option("--start-nm", type=float, default=700.0, show_default=True, help="Defocus at the beginning.")
@click.option("--browser/--no-browser", default=True, help="Open the page.")
def main(output: Path, exposures: int, speed: float, mag_j: float, start_nm: float, browser: bool) -> None:
    """Close the loop on a simulated telescope."""
    calibration = calibrated(output)
    night = Night(mag_j=mag_j, exposures=exposures, start_nm=start_nm)
    trial = Trial(new_folder(output), calibration, night, options=OPTIONS, speed=speed)
    opened, lines = not browser, [0]

    def report(reached: int) -> None:
        nonlocal opened
        if not opened and (url := trial.page_url()):
            opened = True
            print(f"\rpage: {url}", flush=True)
            webbrowser.open(url)
        if sys.stdout.isatty():
            print(f"\rexposure {reached}/{exposures}", end="", flush=True)
        elif reached >= lines[-1] + EXPOSURES_A_LINE:
            lines.append(reached)
            print(f"exposure {reached}/{exposures}", flush=True)

    print(f"telescope and loop start in {trial.folder}", flush=True)
    trial.run(report)
    print("", *lines_of(trial.outcome()), sep="\n")


def calibrated(output: Path, ncpa_nm: Mapping[int, float] | None = None) -> Path:
    """Return a run folder with a calibration, made from a simulated recording if it is not there yet.

    `ncpa_nm` are by Noll index [nm RMS], those of `on_sky` if left out.
    """
    run, data = output / "calibration", output / "simulation"
    if not (run / "results.json").exists():
        print("simulating a calibration and reducing it, a minute or two", flush=True)
        irlos = [sys.executable, "-m", "irlos_pipe"]
        given = [] if ncpa_nm is None else ["--set", "ncpa=" + json.dumps({"zernike_nm": dict(ncpa_nm)})]
        subprocess.run(
            [*irlos, "simulate", "on_sky", "--output", data, *RECORDINGS, *given, "-q"], check=True
        )
        inputs = [f"--input={name}={data / 'data' / name}" for name in ("calibration", "ramp")]
        subprocess.run([*irlos, "run", "defocus_ramp", *inputs, "--output", run, "-q"], check=False)
    if not (run / "results.json").exists():
        raise SystemExit(f"the calibration in {run} failed; see its run.log")
    return run


def new_folder(output: Path) -> Path:
    """Return the next free name of a night in `output`."""
    return next(one for one in (output / f"night-{n}" for n in range(1, 10_000)) if not one.exists())


def lines_of(outcome: Outcome) -> list[str]:
    """What came of the night, for people."""
    first, last = outcome.closed_at + SETTLED, outcome.night.exposures
    valid = sum(one["valid"] for one in outcome.records)
    lines = [
        f"loop closed from {outcome.night.start_nm:.0f} nm after {outcome.closed_at} exposures",
        f"{len(outcome.records)} records, {valid} of them valid; "
        f"{outcome.wrongly_commanded()} offsets commanded without a valid measurement",
    ]
    if last > first:
        lines.append(
            f"residual {outcome.residual_nm(range(first, last)):.1f} nm RMS over {last - first} exposures; "
            f"linear theory expects {outcome.predicted_nm():.1f} nm"
        )
    return lines


if __name__ == "__main__":
    main()
