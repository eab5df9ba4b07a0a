"""Plan a recipe, run what is not up to date, and sum up; also into numbered versions of a folder."""

import errno
import logging
import os
import platform
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePath
from typing import Any

import irlos_pipe
from irlos_pipe.conventions.errors import ExitCode, InputDataError, IrlosError, UnexpectedError
from irlos_pipe.files.atomic import write_bytes, write_if_changed
from irlos_pipe.files.json import json_text, jsonable
from irlos_pipe.pipeline.plan import (
    Action,
    InputFile,
    Selection,
    Step,
    checksum,
    make_plan,
    plan_run,
    remember,
    repaired,
    require_unchanged,
)
from irlos_pipe.pipeline.resources import Resources, limited_threads, resolve_device, run_on_device
from irlos_pipe.pipeline.runlog import ROOT, RUN, TRACE, collected, written_to
from irlos_pipe.product import run_table, runfolder
from irlos_pipe.product.product import Check, Product
from irlos_pipe.product.results import (
    LOST,
    Provenance,
    Recorded,
    RunResults,
    StageResults,
    provenance_of,
    results_of,
)
from irlos_pipe.product.storage import open_product, read_product, write_product
from irlos_pipe.product.table import Origin, table_content
from irlos_pipe.recipe import Recipe
from irlos_pipe.stages import STAGES
from irlos_pipe.stages.base import StageContext, StageOutput, declared_by, reads
from irlos_pipe.stages.ingest.stage import IngestResults


@dataclass
class Job:
    recipe: Recipe
    folder: Path
    files: list[InputFile]
    steps: list[Step]
    resources: Resources
    # Stages whose product on disk is the one the plan promises.
    finished: set[str] = field(default_factory=set)
    _loaded: dict[str, Product] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.finished |= {step.name for step in self.steps if step.current and step.action is not Action.RUN}

    def perform(self) -> None:
        for step in self.steps:
            RUN.info(step.describe())
            if step.action is Action.RUN:
                self._run(step)
                self.finished.add(step.name)

    def summaries(self) -> dict[str, Product]:
        """Return the finished products by stage name, without their arrays."""
        return {
            step.name: read_product(step.path, arrays=False)
            for step in self.steps
            if step.name in self.finished
        }

    def _run(self, step: Step) -> None:
        log = ROOT.getChild(f"stage.{step.name}")
        started, clock = now(), time.perf_counter()
        context = self._context(step, log)
        stage = STAGES[step.name]
        arrays_only = declared_by(stage, "ARRAYS_ONLY")
        with collected(log) as lines, limited_threads(self.resources.jobs, arrays_only=arrays_only):
            output, device = run_on_device(
                lambda device: stage.run(replace(context, device=device)), context.device
            )
        if "inputs" in declared_by(stage, "DEPENDS_ON"):
            require_unchanged(self.files)
        seconds = round(time.perf_counter() - clock, 3)
        times = {"started": started, "finished": now(), "seconds": seconds}
        self._write(step, output, {"device": device, **times}, lines)
        for line in output.failures:
            RUN.warning("%s: lost: %s", step.name, line)
        RUN.info("%s: done in %.1f s", step.name, seconds)

    def _context(self, step: Step, log: logging.Logger) -> StageContext:
        name = step.name
        return StageContext(
            self.recipe.configs[name],
            self.recipe.model,
            self.recipe.instrument,
            self.recipe.inputs,
            self._read_by(name),
            self._device(name),
            self.recipe.seed,
            self.resources.jobs,
            self.resources.progress,
            log,
            runfolder.RunFolder(self.folder).scratch(name, step.key),
        )

    def _device(self, name: str) -> str:
        wanted = self.resources.device
        return (
            "cpu" if wanted == "auto" and declared_by(STAGES[name], "ARRAYS_ONLY") else resolve_device(wanted)
        )

    def _read_by(self, name: str) -> dict[str, Product]:
        """Products of the earlier stages that a stage reads, each opened once."""
        wanted = reads(STAGES[name], self.recipe.stages[: self.recipe.stages.index(name)])
        for step in self.steps:
            if step.name in wanted and step.name not in self._loaded:
                self._loaded[step.name] = open_product(step.path)
        return {other: self._loaded[other] for other in wanted}

    def _write(self, step: Step, output: StageOutput, how: dict[str, Any], log: list[str]) -> None:
        """Write the further files first: the product says that the stage is complete."""
        config = jsonable(self.recipe.configs[step.name])
        before = self._read_by(step.name)
        seen = recordings_of(output.results, before, config)
        notice = self.recipe.notice if self.recipe.samples else ""
        provenance = {
            "key": step.key,
            "parts": step.parts,
            "recipe": self.recipe.name,
            "summary": [*output.summary, *(f"{LOST:16s}{line}" for line in output.failures)],
            "failures": list(output.failures),
            "inputs": self.files,
            "seed": self.recipe.seed,
            "jobs": self.resources.jobs,
            "software": software_versions(),
            "machine": {"host": socket.gethostname(), "platform": platform.platform(), "pid": os.getpid()},
            "command": command_line(),
            **how,
            "recordings": [one.as_json() for one in seen],
            "notice": notice,
        }
        checks = [check for product in before.values() for check in _checks_of(seen, product)]
        origin = Origin(
            step.name,
            f"IRLOS_{step.name.upper()}",
            Provenance.model_validate(jsonable(provenance)),
            seen,
            [*checks, *output.checks],
            config,
            notice,
        )
        files = {
            PurePath(name).name: file
            if isinstance(file, bytes)
            else table_content(file, PurePath(name).suffix, origin)
            for name, file in output.files.items()
        }
        run = runfolder.RunFolder(self.folder)
        run.set_aside(set(_files_beside(step.path)) - files.keys())
        for name, content in files.items():
            write_bytes(self.folder / name, content)
        checksums = {name: checksum(content) for name, content in files.items()}
        provenance |= {"files": sorted(files), "file_sha256": checksums}
        product = Product(
            step.name, output.arrays, output.results.as_json(), list(output.checks), config, provenance, log
        )
        write_product(product, step.path)
        run.remove_scratch(step.name)


def recordings_of(
    results: StageResults, before: Mapping[str, Product], config: Mapping[str, Any]
) -> list[Recorded]:
    """Return the recordings that a stage works on: those of its recipe input, else all that are no darks.

    They stand in the `results` of ingest, or in the product of it among those read `before`.
    """
    if isinstance(results, IngestResults):
        rows = results.inputs
    elif IngestResults.stage in before:
        rows = results_of(IngestResults, before[IngestResults.stage]).inputs
    else:
        return []
    wanted = config.get("input")
    return [
        Recorded.filled_from(row, **dict(row.observed))
        for row in rows
        if row.role != "dark" and wanted in (None, row.input)
    ]


def _checks_of(recordings: Sequence[Recorded], product: Product) -> Iterator[Check]:
    """The checks of a product, of `ingest` those of the recordings."""
    prefixes = tuple(f"ingest/{one.input}/{one.name}/" for one in recordings)
    for check in product.checks:
        if product.stage != IngestResults.stage or check.name.startswith(prefixes):
            yield check


# -- where a product comes from: software, machine, time and command ---------------------------------

GIT_TIMEOUT_S = 5.0
PACKAGES = ("torch", "numpy", "scipy", "astropy", "h5py", "pydantic")


@cache
def software_versions() -> dict[str, str]:
    """Return the versions of irlos_pipe, Python and the packages that numbers depend on.

    That of irlos_pipe has the git revision behind it where it runs from a checkout.
    """
    revision = _git_revision(Path(irlos_pipe.__file__).parents[1])
    own = f"{irlos_pipe.__version__}+{revision}" if revision else irlos_pipe.__version__
    found = {"irlos_pipe": own, "python": platform.python_version()}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def _git_revision(checkout: Path) -> str:
    """Return ``git.`` and the short revision, ``.dirty`` behind it with changes; nothing without git."""
    if not (checkout / ".git").exists():  # a package that is installed, perhaps in somebody else's checkout
        return ""
    command = ["git", "-C", str(checkout), "describe", "--always", "--dirty=.dirty", "--match="]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=GIT_TIMEOUT_S, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return f"git.{answer.stdout.strip()}"


def now() -> str:
    """Return the UTC time in ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def command_line() -> str:
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])


# -- the end of a run, and its begin ------------------------------------------------------------------

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
        planned = make_plan(recipe, folder, files, selection)
        steps = [repaired(step, planned) for step in planned]
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
    _set_outdated_aside(job, run)
    outcome = assess(job.recipe, job.summaries())
    changed = _write_outcome(outcome, run)
    ran = any(step.action is Action.RUN for step in job.steps)
    if changed or ran:
        run.set_figures_aside()
    if job.resources.report and (changed or ran or not run.report.is_file()):
        outcome = replace(outcome, report_error=_report_error(run, job.resources.jobs))
    return replace(outcome, report=run.report if run.report.is_file() else None)


def _write_outcome(outcome: Outcome, run: runfolder.RunFolder) -> bool:
    """Write the files for scripts; True when their content changed."""
    files = {run.results: outcome.results, run.quality: outcome.quality}
    changed = [write_if_changed(path, json_text(content).encode()) for path, content in files.items()]
    return any(changed)


def _report_error(run: runfolder.RunFolder, jobs: int) -> str:
    """Build the report; returns what went wrong, as the products are good without it."""
    try:
        from irlos_pipe.report.build import write_report

        write_report(run.path, jobs)
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
            run.set_aside([run.report.name])
            run.set_figures_aside()
        raise


def _set_others_aside(run: runfolder.RunFolder, steps: Sequence[Step]) -> None:
    """Nobody should take what another recipe left for a result of this one."""
    ours = {step.path for step in steps}
    for path in sorted(set(run.product_files) - ours):
        run.set_aside([*_files_beside(path), path.name])


def _set_outdated_aside(job: Job, run: runfolder.RunFolder) -> None:
    """Further files of products that are no longer those of the recipe."""
    for step in job.steps:
        if step.name not in job.finished:
            run.set_aside(_files_beside(step.path))


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
    return folder / f"{(int(there[-1].name) if there else 0) + 1:0{run_table.DIGITS}d}"


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
    return not others and all(step.current or not step.path.is_file() for step in steps)
