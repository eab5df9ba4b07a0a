"""Reduce one group of recordings with one recipe; an error concerns this reduction only."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from multiprocessing import parent_process
from pathlib import Path
from typing import Protocol

from irlos_pipe.conventions.errors import InputDataError, IrlosError
from irlos_pipe.files.time_limit import TookTooLong, time_limit
from irlos_pipe.night.published_run import PublishedRun
from irlos_pipe.night.tasks import Task
from irlos_pipe.pipeline import Resources, Selection, Step, plan_run, run_recipe
from irlos_pipe.product.results import ResultsPart, read_run_results
from irlos_pipe.product.runfolder import RunFolder
from irlos_pipe.recipe import Recipe

NEW, REDONE, UNCHANGED, FAILED = "new", "redone", "up to date", "failed"


@dataclass(frozen=True)
class Reduced:
    """The outcome of a task.

    Attributes
    ----------
    name, folder : str, Path
        As in the task.
    action : str
        ``new``, ``redone``, ``up to date`` or ``failed``.
    status : str
        As in results.json; ``failed`` also when nothing was written.
    checks_failed : tuple of str
        Messages of the QC checks that failed.
    reasons : tuple of str
        One line per stage that was redone: which, and why.
    problem : str
        The error that stopped it, or a problem beside the results, in one line.
    key : str
        Key of the last product, where it is known; see `Step`.
    log : Path
        The log of the run.
    seconds : float
        Wall time.
    """

    name: str
    folder: Path
    action: str
    status: str = "ok"
    checks_failed: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()
    problem: str = ""
    key: str = ""
    log: Path = Path()
    seconds: float = 0.0

    @property
    def failed(self) -> bool:
        """Whether there are no new products."""
        return self.action == FAILED


class Work(Protocol):
    """The function that a runner calls with every task: `reduce_group`."""

    def __call__(self, task: Task, last: str | None = None, before: Reduced | None = None) -> Reduced:
        """See `reduce_group`."""


class Runner(Protocol):
    """Calls a function with every task, anywhere and in any order."""

    def __call__(self, work: Work, tasks: Sequence[Task]) -> Iterable[Reduced]:
        """Return one outcome of `work` per task of `tasks`, as they are ready."""


def reduce_group(task: Task, last: str | None = None, before: Reduced | None = None) -> Reduced:
    """Bring the products of a task up to date.

    Parameters
    ----------
    task : Task
        The recipe and its recordings.
    last : str, optional
        The stage to stop at, for engines that run stage after stage; products are published with the
        recipe's last stage, or without `last`.
    before : Reduced, optional
        Outcome of the stage before; if that failed, this one is not tried.

    Returns
    -------
    Reduced
        For every error as well; only interruptions are raised.
    """
    if before is not None and before.failed:
        return before
    start = time.perf_counter()
    try:
        with time_limit(task.limit_s, "the reduction", kill=parent_process() is not None):
            reduced = _reduce(task, last)
    except TookTooLong as error:
        reduced = failure(task, str(error))
    except Exception as error:
        reduced = failure(task, _message(error))
    spent = before.seconds if before is not None else 0.0
    return replace(reduced, seconds=round(spent + time.perf_counter() - start, 3))


def failure(task: Task, problem: str) -> Reduced:
    """Return the outcome of a `task` that was stopped by a `problem`."""
    try:
        log = RunFolder(PublishedRun(task.folder).work_folder).log
    except OSError:  # a folder of that name cannot be: that may be the problem
        log = Path()
    return Reduced(task.name, task.folder, FAILED, "failed", problem=problem, log=log)


def planned(task: Task, recipe: Recipe) -> list[Step] | None:
    """Return the plan of every stage of the `recipe` of a `task`; None when there are no products at all.

    Raises
    ------
    IrlosError
        When the inputs cannot be read.
    """
    if not PublishedRun(task.folder).published:
        return None
    return plan_run(recipe, task.folder, Selection())[1]


def unchanged(task: Task) -> Reduced | None:
    """Return the outcome if all products are up to date, else None; an unfinished set is removed then.

    Raises
    ------
    IrlosError
        When the recipe, the inputs or the products cannot be read.
    """
    return _unchanged(task, planned(task, task.load()))


def _unchanged(task: Task, steps: Sequence[Step] | None) -> Reduced | None:
    if steps is None or not all(step.current for step in steps):
        return None
    PublishedRun(task.folder).discard()
    return replace(_outcome(task, RunFolder(task.folder), UNCHANGED), key=steps[-1].key)


def _reduce(task: Task, last: str | None) -> Reduced:
    recipe, published = task.load(), PublishedRun(task.folder)
    steps = planned(task, recipe)
    current = _unchanged(task, steps)
    if current is not None:
        return current
    run = RunFolder(published.prepare())
    outcome = run_recipe(recipe, run.path, Selection(last=last), Resources(task.device, task.threads))
    if last in (None, recipe.stages[-1]):
        published.publish()
        run = RunFolder(task.folder)
    reasons = tuple(step.describe() for step in steps or () if not step.current)
    reduced = _outcome(task, run, NEW if steps is None else REDONE)
    return replace(reduced, reasons=reasons, problem=outcome.report_error)


class _Check(ResultsPart):
    """What is read of a check of qc.json."""

    stage: str
    message: str
    passed: bool


class _Quality(ResultsPart):
    """What is read of qc.json."""

    checks: list[_Check]


def _outcome(task: Task, run: RunFolder, action: str) -> Reduced:
    """Read status and failed checks from the files of a run."""
    try:
        status = read_run_results(run.results).status
        checks = _Quality.model_validate_json(run.quality.read_bytes()).checks
    except (OSError, ValueError, InputDataError) as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise InputDataError(f"{run.path}: cannot be read ({reason}); remove it and run again") from error
    failed = tuple(f"{check.stage}: {check.message}" for check in checks if not check.passed)
    return Reduced(task.name, task.folder, action, status, failed, log=run.log)


def _message(error: Exception) -> str:
    if isinstance(error, IrlosError):
        return next(iter(str(error).splitlines()), type(error).__name__)
    return f"unexpected {type(error).__name__}: {error}"
