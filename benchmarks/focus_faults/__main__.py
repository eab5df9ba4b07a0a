"""Give the loop bad exposures, and hours of right ones, and count what is commanded and what is refused."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from fnmatch import fnmatch
from functools import partial
from pathlib import Path

import click
import numpy as np
from tqdm import tqdm

from benchmarks.focus_faults.cases import all_cases, hours
from benchmarks.focus_faults.files import file_cases, judge_file, judge_visitor, visitor_cases
from benchmarks.focus_faults.judging import Verdict, judge, judge_hour
from benchmarks.focus_faults.sky import SEEINGS, Skies
from benchmarks.focus_faults.table import hours_table, summary, table, write_page
from benchmarks.focus_loop.demo import calibrated
from irlos_pipe.focus.calibration import Calibration, CalibrationRequest

REPORTED_SEED = 4  # of the reported run; the limits of the loop rest on the skies of seeds 1 to 3
HOUR_MAGNITUDES = (8.0, 12.0, 15.0, 17.0, 18.5)


@click.command()
@click.option("--output", type=click.Path(path_type=Path, file_okay=False), required=True)
@click.option("--seed", default=REPORTED_SEED, show_default=True, help="Of the skies and all draws.")
@click.option("--only", default="*", help="Cases whose name matches, for example 'light.*'.")
@click.option("--hours/--no-hours", "with_hours", default=True, help="Hours of right exposures.")
@click.option("--docs", is_flag=True, help="Put the tables into docs/focus.md.")
def main(output: Path, seed: int, only: str, with_hours: bool, docs: bool) -> None:
    """Run the suite; the folder keeps a calibration and the tables of the skies."""
    calibration = CalibrationRequest(calibrated(output), despite_qc=True).load()
    skies, trials = Skies(output / "skies", seed), output / "trials"
    shutil.rmtree(trials, ignore_errors=True)
    began_s = time.monotonic()
    verdicts = [work() for _, work in tqdm(_chosen(skies, calibration, trials, only), desc="cases")]
    (output / "verdicts.json").write_text(json.dumps([asdict(one) for one in verdicts], indent=1))
    click.echo(table(verdicts))
    text = f"{summary(verdicts)}\n\n{table(verdicts, used_only=True)}"
    click.echo(summary(verdicts))
    if with_hours:
        found = [
            judge_hour(name, seeing, mag_j, changes, skies, calibration, trials / "hours" / name)
            for name, seeing, mag_j, changes in tqdm([*hours(SEEINGS, HOUR_MAGNITUDES)], desc="hours")
        ]
        click.echo(hours_table(found))
        text += f"\n\n{hours_table(found)}"
    failed = [one for one in verdicts if one.failed]
    for one in failed:
        click.echo(f"{one.case}: {one.commanded_wrongly} wrong, {one.refused} refused {one.problem}")
    click.echo(f"{len(verdicts)} cases in {time.monotonic() - began_s:.0f} s")
    if docs:
        write_page(text)


Work = Callable[[], Verdict]


def _chosen(skies: Skies, calibration: Calibration, trials: Path, only: str) -> list[tuple[str, Work]]:
    return [(name, work) for name, work in _all(skies, calibration, trials) if fnmatch(name, only)]


def _all(skies: Skies, calibration: Calibration, trials: Path) -> Iterator[tuple[str, Work]]:
    for case in all_cases():
        yield case.name, partial(judge, case, skies, calibration, trials / case.name)
    for number, (name, known, harm) in enumerate(file_cases()):
        folder = trials / f"files_{number}"
        yield f"files.{name}", partial(judge_file, name, known, harm, skies, calibration, folder)
    for number, (name, trial) in enumerate(visitor_cases()):
        yield f"visitors.{name}", partial(judge_visitor, name, trial, trials / f"visitors_{number}")


if __name__ == "__main__":
    np.seterr(all="ignore")
    main(prog_name="python -m benchmarks.focus_faults")
