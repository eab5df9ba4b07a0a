"""From the runs of all experiments to one report and a folder of numbers, one CSV file per experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError
from irlos_pipe.files.atomic import write_if_changed
from irlos_pipe.files.json import canonical_json
from irlos_pipe.paper.common.table import csv_of_tables, csv_text, read_csv
from irlos_pipe.paper.run.recipes import Experiment
from irlos_pipe.pipeline import Selection, plan_run
from irlos_pipe.product.product import Product
from irlos_pipe.product.results import provenance_of
from irlos_pipe.product.runfolder import RunFolder, existing_run
from irlos_pipe.product.storage import read_product
from irlos_pipe.report.collection import Chapter, read_chapter, write_collection
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.base import judged

TABLES = "tables"  # folder of numbers; beside a file per experiment it holds how they were made, and judged
RUNS, CHECKS = "runs.csv", "checks.csv"
OWN = "irlos_pipe"
TITLE = "The experiments of the paper"
NOTES = {True: "Quick look: samples are small and numbers rough.", False: "Full samples."}


def require_size(folder: Path, quick: bool) -> None:
    """Refuse to replace full experiments by quick ones, or the reverse.

    Parameters
    ----------
    folder : Path
        Of all experiments.
    quick : bool
        Size of those to be run.

    Raises
    ------
    ConfigurationError
        When the folder holds experiments of the other size.
    """
    path = folder / TABLES / RUNS
    if path.is_file() and any(run["quick"] != str(quick) for run in read_csv(path)):
        held = "full experiments, and --quick was" if quick else "--quick experiments, and --quick was not"
        raise ConfigurationError(f"--output {folder}: holds {held} given; choose another folder")


def collect_numbers(known: Sequence[Experiment], folder: Path, quick: bool) -> Path:
    """Write the numbers of all experiments that are up to date; return their folder.

    What changes from run to run (times, machine, software) stands in ``runs.csv``; all the rest is the same
    for the same recipes and software.

    Parameters
    ----------
    known : sequence of Experiment
        All, in the order of the paper.
    folder : Path
        Holds their runs.
    quick : bool
        Whether their samples are small.
    """
    tables = folder / TABLES
    tables.mkdir(exist_ok=True)
    runs, checks = [], []
    for one in known:
        path = tables / f"{one.name}.csv"
        if not _is_current(one, folder):
            path.unlink(missing_ok=True)
            continue
        for stage, file in existing_run(folder / one.name).products().items():
            product = read_product(file, arrays=False)
            runs.append(_run(one.name, quick, product))
            checks += [
                {"experiment": one.name, **check.as_dict()} for check in judged(STAGES[stage], product)
            ]
            if own := product.results.get("tables"):
                write_if_changed(path, csv_of_tables(own).encode())
    for name, rows in ((RUNS, runs), (CHECKS, checks)):
        write_if_changed(tables / name, csv_text(rows).encode())
    return tables


def _run(experiment: str, quick: bool, product: Product) -> dict[str, Any]:
    """How a product was made; the name of the host is left out."""
    made = provenance_of(product)
    others = [f"{name} {version}" for name, version in made.software.items() if name != OWN]
    return {
        "experiment": experiment,
        "stage": product.stage,
        "quick": quick,
        "seed": made.seed,
        "code": made.software.get(OWN, ""),
        "finished": made.finished,
        "seconds": made.seconds,
        "jobs": made.jobs,
        "device": made.device,
        "platform": made.machine.platform,
        "software": ", ".join(others),
        "sizes": canonical_json(product.config),
    }


def collect_reports(
    known: Sequence[Experiment], folder: Path, quick: bool, problems: Mapping[str, str]
) -> Path:
    """Write the report on all experiments that are up to date or failed; return its path.

    The parameters are those of `collect_numbers`, and `problems`, what stopped an experiment, by name:
    `known`, `folder`, `quick`.
    """
    shown = [one for one in known if one.name in problems or _is_current(one, folder)]
    chapters = [_chapter(one, folder / one.name, problems.get(one.name, "")) for one in shown]
    return write_collection(RunFolder(folder).report, TITLE, NOTES[quick], chapters)


def _is_current(experiment: Experiment, folder: Path) -> bool:
    """Whether the products on disk are those of the recipe as it is now."""
    try:
        _, steps = plan_run(experiment.recipe, folder / experiment.name, Selection())
    except IrlosError:
        return False
    return all(step.current for step in steps)


def _chapter(experiment: Experiment, folder: Path, problem: str) -> Chapter:
    try:
        return read_chapter(experiment.name, folder, problem)
    except Exception as error:  # the others can be shown without it
        reason = problem or f"cannot be shown: {type(error).__name__}: {error}"
        return Chapter(experiment.name, experiment.title, problems=[reason])
