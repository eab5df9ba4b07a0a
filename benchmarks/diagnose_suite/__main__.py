"""Hide effects in simulated recordings and see whether `diagnose` names them."""

from __future__ import annotations

from concurrent.futures import as_completed
from fnmatch import fnmatch
from pathlib import Path

import click
import numpy as np
from tqdm import tqdm

from benchmarks.diagnose_suite.cases import Case, all_cases, in_one_setting
from benchmarks.diagnose_suite.kept import keep, lay_out
from benchmarks.diagnose_suite.report import write_report
from benchmarks.diagnose_suite.working import Folder, work
from irlos_pipe.files.processes import in_processes

REPORTED_SEED = 86602540  # of the reported runs; no threshold may rest on its cases


@click.command()
@click.option("--output", type=click.Path(path_type=Path, file_okay=False), help="Folder for everything.")
@click.option("--dirty", is_flag=True, help="Beside what is hidden, everything has a mild error.")
@click.option(
    "--seed",
    "suite_seed",
    type=click.IntRange(0, 2**32 - 1),
    default=REPORTED_SEED,
    show_default=True,
    help="Of all draws. Whoever changes `diagnose` takes another one than the reported.",
)
@click.option("--jobs", default=1, show_default=True, help="Worker processes, of one thread each.")
@click.option("--only", default="*", help="Cases whose name matches, for example '*companion*'.")
@click.option("--once", is_flag=True, help="Each in one of its settings, which take turns.")
@click.option("--sample", type=int, help="That many of them, evenly spread.")
@click.option("--shuffled", is_flag=True, help="In random order: wherever it is stopped, a fair sample.")
@click.option(
    "--kept",
    type=click.Path(path_type=Path, dir_okay=False),
    help="File whose outcomes count as finished; those of this run are added.",
)
@click.option("--finished", is_flag=True, help="Those among them that are finished already; run none.")
@click.option("--list", "listed", is_flag=True, help="Print the names of the cases and stop.")
def main(
    output: Path | None,
    dirty: bool,
    suite_seed: int,
    jobs: int,
    only: str,
    once: bool,
    sample: int | None,
    shuffled: bool,
    kept: Path | None,
    finished: bool,
    listed: bool,
) -> None:
    """Hide effects in simulated recordings and see whether `diagnose` names them.

    A folder is gone on with where it stopped: finished cases are kept.
    """
    every = all_cases(suite_seed, dirty)
    cases = chosen(in_one_setting(every) if once else every, only, sample)
    if shuffled:
        cases = list(np.random.default_rng(suite_seed).permutation(np.array(cases, dtype=object)))
    if listed:
        click.echo("\n".join(case.name for case in cases))
        return
    if output is None:
        raise click.UsageError("give --output DIR, a folder for the recordings and the results")
    folder = Folder(output.resolve())
    if kept is not None:
        lay_out(kept, cases, folder)
    if finished:
        cases = [case for case in cases if folder.outcome(case).is_file()]
    outcomes, failed = run_all(cases, folder, jobs)
    if kept is not None:
        keep(kept, outcomes)
    click.echo(write_report(outcomes, failed, output))
    raise SystemExit(1 if failed else 0)


def chosen(cases: list[Case], only: str = "*", sample: int | None = None) -> list[Case]:
    """Cases whose name matches a pattern, or some of them, evenly spread."""
    matching = [case for case in cases if fnmatch(case.name, only)]
    if sample is None or sample >= len(matching):
        return matching
    return [matching[index] for index in np.linspace(0, len(matching) - 1, sample).astype(int)]


def run_all(cases: list[Case], folder: Folder, jobs: int) -> tuple[list[dict], dict[str, str]]:
    """Outcomes of the cases, and what stopped those that have none."""
    outcomes, failed = [], {}
    tasks = [(case, folder) for case in cases]
    with in_processes(min(jobs, max(len(cases), 1)), work, tasks) as futures:
        names = dict(zip(futures, (case.name for case in cases), strict=True))
        for future in tqdm(as_completed(futures), total=len(cases), desc="cases"):
            try:
                outcomes.append(future.result())
            except Exception as problem:  # one case that breaks must not end hours of others
                failed[names[future]] = f"{type(problem).__name__}: {problem}"
    return sorted(outcomes, key=lambda one: one["case"]), failed


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.diagnose_suite")
