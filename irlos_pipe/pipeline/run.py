"""Plan a recipe, run what is not up to date, and sum up; also into numbered versions of a folder."""

import errno
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ExitCode, InputDataError, IrlosError, UnexpectedError
from irlos_pipe.files.atomic import write_if_changed
from irlos_pipe.files.json import json_text
from irlos_pipe.pipeline.execution import Job
from irlos_pipe.pipeline.inputs import InputFile, input_files, remember
from irlos_pipe.pipeline.plan import NO_PRODUCT, Action, Selection, Step, make_plan, with_repairs
from irlos_pipe.pipeline.provenance import command_line
from irlos_pipe.pipeline.resources import Resources
from irlos_pipe.pipeline.runlog import RUN, TRACE, written_to
from irlos_pipe.product import run_table, runfolder
from irlos_pipe.product.product import Product
from irlos_pipe.product.results import RunResults, provenance_of
from irlos_pipe.product.storage import read_product
from irlos_pipe.recipe import Recipe
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.base import files_of

EXIT_CODES = {
    "ok": ExitCode.DONE,
    "qc_failed": ExitCode.QUALITY,
    "partial": ExitCode.PARTIAL,
    "failed": ExitCode.UNEXPECTED,
}


@dataclass(frozen=True)
class Outcome:
    """The end of a run."""

    status: str  # ``ok``, ``qc_failed``, ``partial`` or ``failed``
    results: dict[str, Any]  # content of results.json
    quality: dict[str, Any]  # content of qc.json
    summary: dict[str, list[str]] = field(default_factory=dict)  # lines for people by stage
    report: Path | None = None
    report_error: str = ""  # why the report could not be built

    @property
    def exit_code(self) -> int:
        """Exit code of the command; a report that could not be built is an error of its own."""
        return EXIT_CODES[self.status] or int(bool(self.report_error))


def assess(recipe: Recipe, products: Mapping[str, Product], error: str = "") -> Outcome:
    """Sum up the up-to-date `products` of a run, which an `error` may have stopped."""
    status = "failed" if error else _status(products)
    results = RunResults(
        schema="irlos-results",
        schema_version=1,
        recipe=recipe.name,
        status=status,
        **({"notice": recipe.notice, "samples": list(recipe.samples)} if recipe.samples else {}),
        instrument=recipe.instrument.name,
        stages={name: product.results for name, product in products.items()},
        **({"error": error} if error else {}),
    )
    checks = [
        {"stage": name, **check.as_dict()} for name, product in products.items() for check in product.checks
    ]
    quality = {
        "schema": "irlos-qc",
        "schema_version": 1,
        "recipe": recipe.name,
        "passed": all(check["passed"] for check in checks),
        "checks": checks,
    }
    summary = {name: provenance_of(product).summary for name, product in products.items()}
    return Outcome(status, results.as_json(), quality, summary)


def _status(products: Mapping[str, Product]) -> str:
    # A failed limit outranks lost exposures: it says that the result may not be used.
    if any(not check.passed for product in products.values() for check in product.checks):
        return "qc_failed"
    if any(provenance_of(product).failures for product in products.values()):
        return "partial"
    return "ok"


def plan_run(recipe: Recipe, folder: Path, selection: Selection) -> tuple[list[InputFile], list[Step]]:
    """Return the input files and the plan of a run into `folder`, which need not exist; nothing is written.

    Raises `ConfigurationError` when the selection or the output folder cannot be used, and `InputDataError`
    or `NothingToDo` when input files cannot be read, or there are none.
    """
    runfolder.require_free(folder)
    runfolder.require_outside_inputs(folder, recipe.inputs)
    readers = filter(None, (files_of(STAGES[name]) for name in recipe.stages))
    files = input_files(recipe.inputs, folder, next(readers, None))
    return files, make_plan(recipe, folder, files, selection)


def run_recipe(
    recipe: Recipe, folder: Path, selection: Selection | None = None, resources: Resources | None = None
) -> Outcome:
    """Bring the products of a recipe in `folder` up to date, which is made if it does not exist.

    By default all stages may run, on one thread of the processor.

    Raises `Locked` when another run owns the folder, and `IrlosError` when a stage cannot do its work;
    products of finished stages stay.
    """
    selection = selection or Selection()
    inputs = runfolder.inputs_stamp(path for paths in recipe.inputs.values() for path in paths)
    # Planned once before the folder is made, so that a mistake leaves no empty folder behind.
    files, _ = plan_run(recipe, folder, selection)
    with runfolder.owned_folder(folder) as run, written_to(run.log), _reported_in_one_line(run.log):
        steps = with_repairs(make_plan(recipe, folder, files, selection))
        TRACE.info("command: %s", command_line())
        if any(step.action is Action.RUN for step in steps):
            RUN.info("instrument: %s", recipe.instrument_text)
        if recipe.notice:
            RUN.warning(recipe.notice)
        remember(files, folder)
        write_if_changed(run.recipe, recipe.resolved_yaml().encode())
        _set_others_aside(run, steps)
        job = Job(recipe, folder, files, steps, resources or Resources())
        with _failure_recorded(job, run):
            job.perform()
        outcome = _concluded(job, run)
        if all(step.action in (Action.RUN, Action.SKIP) for step in steps):
            runfolder.remember_standing(run, inputs)
        return outcome


def _concluded(job: Job, run: runfolder.RunFolder) -> Outcome:
    outcome = assess(job.recipe, job.summaries())
    changed = _write_outcome(outcome, run)
    ran = any(step.action is Action.RUN for step in job.steps)
    if changed or ran:
        run.set_figures_aside()
    if job.resources.report and (changed or ran or not run.report.is_file()):
        outcome = replace(outcome, report_error=_report_error(run))
    return replace(outcome, report=run.report if run.report.is_file() else None)


def _write_outcome(outcome: Outcome, run: runfolder.RunFolder) -> bool:
    """Write the files for scripts; True when their content changed."""
    files = {run.results: outcome.results, run.quality: outcome.quality}
    changed = [write_if_changed(path, json_text(content).encode()) for path, content in files.items()]
    return any(changed)


def _report_error(run: runfolder.RunFolder) -> str:
    """Build the report; returns what went wrong, as the products are good without it."""
    try:
        from irlos_pipe.report.build import write_report

        write_report(run.path)
    except Exception as error:
        TRACE.info("the report could not be built", exc_info=True)
        return f"{run.report}: could not be built: {_first_line(error)}; the traceback is in {run.log}"
    return ""


@contextmanager
def _failure_recorded(job: Job, run: runfolder.RunFolder) -> Iterator[None]:
    """Leave a results.json that says what stopped the run, next to the products that were finished."""
    try:
        yield
    except BaseException as error:
        reason = "interrupted" if isinstance(error, KeyboardInterrupt) else _first_line(error)
        # A full disk may be what stopped the run; the first error is the one to report.
        with suppress(IrlosError):
            _write_outcome(assess(job.recipe, job.summaries(), error=reason), run)
            _set_outdated_aside(job, run)
        raise


def _set_others_aside(run: runfolder.RunFolder, steps: Sequence[Step]) -> None:
    """Nobody should take what another recipe left for a result of this one."""
    ours = {step.path for step in steps}
    for path in sorted(set(run.product_files) - ours):
        run.set_aside([*_files_beside(path), path.name])


def _set_outdated_aside(job: Job, run: runfolder.RunFolder) -> None:
    """After an error: further files of what was to be made again, and a report that says all is well."""
    for step in job.steps:
        if step.name not in job.finished and step.path.is_file():
            run.set_aside(_files_beside(step.path))
    run.set_aside([run.report.name])
    run.set_figures_aside()


def _files_beside(product: Path) -> list[str]:
    """Names of the further files of a product; none where it cannot be read."""
    try:
        return provenance_of(read_product(product, arrays=False)).files
    except InputDataError:
        return []


@contextmanager
def _reported_in_one_line(log: Path) -> Iterator[None]:
    """Turn any exception into one whose message is one line; the traceback goes to the log."""
    try:
        yield
    except KeyboardInterrupt:
        TRACE.info("interrupted")
        raise
    except IrlosError as error:
        TRACE.info("stopped: %s", error, exc_info=error.__cause__)
        raise
    except Exception as error:
        TRACE.info("stopped by an unexpected error", exc_info=True)
        raise _clear_error(error, log) from error


def _clear_error(error: Exception, log: Path) -> IrlosError:
    if isinstance(error, MemoryError):
        return IrlosError(f"out of memory; use fewer --jobs or a smaller input (details in {log})")
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        return IrlosError(f"{error.filename or log.parent}: the disk is full; free some space and run again")
    if isinstance(error, OSError) and error.filename:
        return InputDataError(f"{error.filename}: {error.strerror}")
    return UnexpectedError(f"unexpected {_first_line(error)}; the traceback is in {log}")


def _first_line(error: BaseException) -> str:
    text = next(iter(str(error).splitlines()), "")
    return text if isinstance(error, IrlosError) else f"{type(error).__name__}: {text}"


# -- numbered versions: what is there stays, what differs gets a new number ---------------------


def version_for(recipe: Recipe, folder: Path, selection: Selection) -> Path:
    """Return the folder that a run would use: the newest version if the run would change nothing in it.

    A run that only adds what the newest version has not got, after an interruption for example, continues it.

    Raises `ConfigurationError` when the folder cannot hold versions, or the selection cannot be used, and
    `InputDataError` or `NothingToDo` when input files cannot be read, or there are none.
    """
    run_table.require_free_for_versions(folder)
    there = run_table.version_folders(folder)
    if there and not selection.force and _only_adds(recipe, there[-1], selection):
        return there[-1]
    return run_table.new_version(folder)


def run_numbered(
    recipe: Recipe, folder: Path, selection: Selection | None = None, resources: Resources | None = None
) -> Outcome:
    """Bring the products of a recipe up to date without changing a version in `folder`; see `run_recipe`.

    The link ``latest`` leads to the version if it is complete.

    Raises `Locked` when another run works on these versions, and `IrlosError` when a stage cannot do its
    work; ``latest`` leads to where it led before.
    """
    selection = selection or Selection()
    plan_run(recipe, version_for(recipe, folder, selection), selection)  # a mistake leaves no folder behind
    with runfolder.owned_folder(folder):
        version = version_for(recipe, folder, selection)
        outcome = run_recipe(recipe, version, selection, resources)
        if run_table.is_complete(runfolder.RunFolder(version)):
            run_table.link_latest(folder, version)
        return outcome


def _only_adds(recipe: Recipe, version: Path, selection: Selection) -> bool:
    """Whether a run into a version would make only products that are not there."""
    run = runfolder.RunFolder(version)
    if not run.recipe.is_file():
        return True
    _, steps = plan_run(recipe, version, selection)
    others = set(run.product_files) - {step.path for step in steps}
    return not others and all(step.action is not Action.RUN or step.reason == NO_PRODUCT for step in steps)
