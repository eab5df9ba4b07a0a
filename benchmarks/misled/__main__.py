"""Reduce plausible but wrong inputs, and right ones, and count what is accused and what misleads."""

from __future__ import annotations

from concurrent.futures import as_completed
from fnmatch import fnmatch
from pathlib import Path

import click
import numpy as np
from tqdm import tqdm

from benchmarks.misled.cases import all_cases
from benchmarks.misled.table import summary, table, write_page
from benchmarks.misled.working import work
from irlos_pipe.files.processes import in_processes

REPORTED_SEED = 14142135  # of the reported runs; no limit may rest on its cases, 16180339 is for trials


@click.command()
@click.option("--output", type=click.Path(path_type=Path, file_okay=False), required=True)
@click.option("--seed", "suite_seed", default=REPORTED_SEED, show_default=True, help="Of all draws.")
@click.option("--draws", default=3, show_default=True, help="Of every family and setting.")
@click.option("--jobs", default=1, show_default=True, help="Worker processes, of one thread each.")
@click.option("--only", default="*", help="Cases whose name matches, for example 'ramp.*'.")
@click.option("--sample", type=int, help="That many of them, evenly spread.")
@click.option("--finished", is_flag=True, help="Those that are finished already; run none.")
@click.option("--docs", is_flag=True, help="Put the table into docs/reliability.md.")
def main(
    output: Path,
    suite_seed: int,
    draws: int,
    jobs: int,
    only: str,
    sample: int | None,
    finished: bool,
    docs: bool,
) -> None:
    """Run the suite; a folder is gone on with where it stopped."""
    output.mkdir(parents=True, exist_ok=True)
    cases = [case for case in all_cases(suite_seed, draws) if fnmatch(case.name, only)]
    if sample is not None and sample < len(cases):
        cases = [cases[index] for index in np.linspace(0, len(cases) - 1, sample).astype(int)]
    if finished:
        cases = [case for case in cases if (output / f"{case.name}.json").is_file()]
    outcomes, broken = [], {}
    with in_processes(max(1, min(jobs, len(cases))), work, [(case, output) for case in cases]) as futures:
        names = dict(zip(futures, (case.name for case in cases), strict=True))
        for future in tqdm(as_completed(futures), total=len(cases), desc="cases"):
            try:
                outcomes.append(future.result())
            except Exception as problem:  # one case that breaks must not end the others
                broken[names[future]] = f"{type(problem).__name__}: {problem}"
    text = f"{table(outcomes)}\n\n{summary(outcomes)}"
    click.echo("\n".join([text, *(f"{name}: {why}" for name, why in broken.items())]))
    if docs:
        write_page(text)
    raise SystemExit(1 if broken else 0)


if __name__ == "__main__":
    main(prog_name="python -m benchmarks.misled")
