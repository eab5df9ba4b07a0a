"""Run the experiments one after the other, and collect them in one report and a folder of numbers.

An experiment that fails does not stop the others.
"""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ConfigurationError, ExitCode, IrlosError
from irlos_pipe.conventions.text import aligned, suggestion
from irlos_pipe.files.atomic import write_if_changed
from irlos_pipe.files.json import canonical_json
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.paper.common.table import csv_of_tables, csv_text, read_csv
from irlos_pipe.pipeline import Outcome, Resources, Selection, plan_run, run_recipe
from irlos_pipe.pipeline.runlog import RUN
from irlos_pipe.pipeline.terminal import quality_line
from irlos_pipe.product.product import Product
from irlos_pipe.product.results import provenance_of
from irlos_pipe.product.runfolder import RunFolder, existing_run, owned_folder, require_free
from irlos_pipe.product.storage import read_product
from irlos_pipe.recipe import Recipe, load_recipe
from irlos_pipe.report.collection import Chapter, read_chapter, write_collection
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.base import judged

QUICK_NAME = "quick.yaml"

TABLES = "tables"  # folder of numbers: a file per experiment, and how they were made and judged
RUNS, CHECKS = "runs.csv", "checks.csv"
OF_THE_PAPER = (TABLES, "*/recipe.resolved.yaml")
OWN = "irlos_pipe"
NOTES = {True: "Quick look: samples are small and numbers rough.", False: "Full samples."}


@dataclass(frozen=True)
class Experiment:
    """A recipe and the name of its file and folder; one not `wanted` is shown only when it is up to date."""

    name: str
    recipe: Recipe
    wanted: bool = True


def find_experiments(
    folder: Path, *, quick: bool = False, only: Collection[str] = (), seed: int | None = None
) -> list[Experiment]:
    """Load the recipes of a folder, in the order in which the package lists their last stages.

    With `quick` they are changed as ``quick.yaml`` next to them says: ``{recipe: {stage.key: value}}``.
    `only` names those to run, all if empty; others that are not valid are left out. A `seed` replaces that of
    every recipe.

    Raises `ConfigurationError` when there are no recipes, one of those to run is not valid, or a name is
    unknown.
    """
    paths = {path.stem: path for path in sorted(folder.glob("*.yaml")) if path.name != QUICK_NAME}
    if not paths:
        raise ConfigurationError(
            f"--recipes {folder}: no recipes there; give a folder of recipes, or leave the option out"
        )
    for name in only:
        if name not in paths:
            raise ConfigurationError(f"--only {name}: no such experiment{suggestion(name, paths)}")
    changes = _quick_changes(folder / QUICK_NAME, paths) if quick else {}
    found = []
    for name, path in paths.items():
        settings = [f"{key}={json.dumps(value)}" for key, value in changes.get(name, {}).items()]
        wanted = not only or name in only
        try:
            found.append(Experiment(name, load_recipe(path, settings, seed=seed), wanted))
        except ConfigurationError as error:
            if wanted:
                # The recipe reports them as options of the command line; they stand in this file.
                text = str(error).replace("--set ", f"{folder / QUICK_NAME}: ")
                raise ConfigurationError(text) from error
    return sorted(found, key=lambda one: list(STAGES).index(one.recipe.stages[-1]))


def _quick_changes(path: Path, known: Collection[str]) -> Mapping[str, Mapping[str, Any]]:
    changes, lines = load_yaml(path)
    for name, settings in changes.items():
        where = f"{path}:{lines[name,]}"
        if name not in known:
            raise ConfigurationError(f"{where}: no recipe '{name}'{suggestion(name, known)}")
        if not isinstance(settings, dict):
            raise ConfigurationError(f"{where}: '{name}' should be a section of 'stage.key: value' lines")
    return changes


@dataclass(frozen=True)
class PaperRun:
    """Outcome of the run of all experiments: of those that came to an end, and what stopped the others."""

    outcomes: dict[str, Outcome]
    problems: dict[str, str]
    report: Path
    numbers: Path

    @property
    def exit_code(self) -> int:
        """Return 0, or 5 when an experiment failed or lost a part, or 4 when a QC limit failed."""
        codes = {outcome.exit_code for outcome in self.outcomes.values()}
        if self.problems or codes - {ExitCode.DONE, ExitCode.QUALITY}:
            return ExitCode.PARTIAL
        return max(codes, default=ExitCode.DONE)

    def summary(self) -> str:
        """Return the summary lines of every experiment and where the files are, for the terminal."""
        rows = []
        for name, outcome in self.outcomes.items():
            quality = f", {quality_line(outcome)}" if outcome.quality["checks"] else ""
            rows.append((name, outcome.status.replace("_", " ") + quality))
            rows += [(name, line) for lines in outcome.summary.values() for line in lines]
        rows += [(name, f"failed: {problem}") for name, problem in self.problems.items()]
        return aligned([*rows, ("report", str(self.report)), ("numbers", str(self.numbers))])


def run_paper(known: Sequence[Experiment], folder: Path, quick: bool, resources: Resources) -> PaperRun:
    """Bring the wanted experiments up to date, each in a folder of its own, and collect all of them.

    Those `known` are in the order of the paper; those not wanted are collected when they are up to date. The
    `folder` is made if it does not exist; `quick` says whether samples are small.

    Raises `ConfigurationError` when the folder holds experiments of the other size, `Locked` when it is in
    use, and `IrlosError` when it cannot be written.
    """
    require_free(folder, OF_THE_PAPER)
    runs = folder / TABLES / RUNS
    if runs.is_file() and any(run["quick"] != str(quick) for run in read_csv(runs)):
        held = "full experiments, and --quick was" if quick else "--quick experiments, and --quick was not"
        raise ConfigurationError(f"--output {folder}: holds {held} given; choose another folder")
    wanted = [one for one in known if one.wanted]
    outcomes, problems = {}, {}
    with owned_folder(folder):
        for number, experiment in enumerate(wanted, 1):
            name = experiment.name
            RUN.info("experiment %d of %d: %s", number, len(wanted), name)
            try:
                outcome = run_recipe(experiment.recipe, folder / name, None, resources)
            except IrlosError as error:
                problems[name] = str(error).splitlines()[0]
                RUN.warning("%s: failed: %s", name, error)
            else:
                outcomes[name] = outcome
                if outcome.report_error:
                    RUN.warning("%s: %s", name, outcome.report_error)
            # After each experiment, so that the numbers so far can be looked at.
            _write_numbers(known, folder, quick)
        shown = [one for one in known if one.name in problems or _is_current(one, folder)]
        chapters = [_chapter(one, folder / one.name, problems.get(one.name, "")) for one in shown]
        report = write_collection(RunFolder(folder).report, NOTES[quick], chapters)
    return PaperRun(outcomes, problems, report, folder / TABLES)


def _write_numbers(known: Sequence[Experiment], folder: Path, quick: bool) -> None:
    """Write the numbers of all experiments that are up to date.

    What changes from run to run (times, machine, software) stands in ``runs.csv``; all the rest is the same
    for the same recipes and software.
    """
    tables = folder / TABLES
    tables.mkdir(exist_ok=True)
    runs: list[Mapping[str, Any]] = []
    checks: list[Mapping[str, Any]] = []
    for one in known:
        path = tables / f"{one.name}.csv"
        if not _is_current(one, folder):
            path.unlink(missing_ok=True)
            continue
        for stage, file in existing_run(folder / one.name).products().items():
            product, of = read_product(file, arrays=False), {"experiment": one.name}
            runs.append(of | {"stage": stage, "quick": quick} | _made(product))
            checks += [of | check.as_dict() for check in judged(STAGES[stage], product)]
            if own := product.results.get("tables"):
                write_if_changed(path, csv_of_tables(own).encode())
    for name, rows in ((RUNS, runs), (CHECKS, checks)):
        write_if_changed(tables / name, csv_text(rows).encode())


def _made(product: Product) -> dict[str, Any]:
    """How a product was made; the name of the host is left out."""
    made = provenance_of(product)
    return {
        "seed": made.seed,
        "code": made.software.get(OWN, ""),
        "finished": made.finished,
        "seconds": made.seconds,
        "jobs": made.jobs,
        "device": made.device,
        "platform": made.machine.platform,
        "software": ", ".join(f"{name} {one}" for name, one in made.software.items() if name != OWN),
        "sizes": canonical_json(product.config),
    }


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
        return Chapter(experiment.name, experiment.recipe.title or experiment.name, problems=[reason])
