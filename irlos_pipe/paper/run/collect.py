"""From the runs of all experiments to one report and one file of numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError
from irlos_pipe.files.atomic import write_if_changed
from irlos_pipe.files.json import json_text
from irlos_pipe.paper.run.experiments import Experiment
from irlos_pipe.paper.run.results import paper_results
from irlos_pipe.pipeline import Selection, plan_run
from irlos_pipe.product.runfolder import RunFolder
from irlos_pipe.report.chapter import Chapter, read_chapter
from irlos_pipe.report.collection import write_collection

RESULTS_NAME = "paper_results.json"
TITLE = "The experiments of the paper"
NOTES = {True: "Quick look: samples are small and numbers rough.", False: "Full samples."}


def require_size(folder: Path, quick: bool) -> None:
    """Refuse to replace the products of many hours by those of a quick look, and the reverse.

    Raises
    ------
    ConfigurationError
        When the folder holds experiments of the other size.
    """
    path = folder / RESULTS_NAME
    if path.is_file() and json.loads(path.read_text())["quick"] != quick:
        held = "full experiments, and --quick was" if quick else "--quick experiments, and --quick was not"
        raise ConfigurationError(f"--output {folder}: holds {held} given; choose another folder")


def collect_numbers(known: Sequence[Experiment], folder: Path, quick: bool) -> Path:
    """Write paper_results.json from all experiments that are up to date."""
    current = {one.name: folder / one.name for one in known if _is_current(one, folder)}
    missing = [one.name for one in known if one.name not in current]
    path = folder / RESULTS_NAME
    write_if_changed(path, json_text(paper_results(current, quick, missing)).encode())
    return path


def collect_reports(
    known: Sequence[Experiment], folder: Path, quick: bool, problems: Mapping[str, str]
) -> Path:
    """Write the report on all experiments that are up to date or failed."""
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
        told = problem or f"cannot be shown: {type(error).__name__}: {error}"
        return Chapter(experiment.name, experiment.title, problems=[told])
