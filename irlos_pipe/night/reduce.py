"""Reduce one group of recordings with one recipe; whatever goes wrong with it stays with it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import InputDataError, IrlosError
from irlos_pipe.night.place import Place
from irlos_pipe.pipeline import Resources, Selection, Step, plan_run, run_recipe
from irlos_pipe.product.runfolder import RunFolder
from irlos_pipe.recipe import Recipe, load_recipe

NEW, REDONE, UNCHANGED, FAILED = "new", "redone", "up to date", "failed"


@dataclass(frozen=True)
class Task:
    """A recipe and the recordings it is to be run on: small, and the same in any process on any machine.

    Attributes
    ----------
    name : str
        ``<night>/<group>/<recipe>``, unique in the tree.
    folder : Path
        Where the products are found when they are complete, see `Place`.
    recipe, settings, inputs :
        As `load_recipe` takes them.
    device : str
        ``cpu`` or ``cuda``.
    threads : int
        For the process that works on it; results do not depend on it.
    """

    name: str
    folder: Path
    recipe: Path
    settings: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    device: str = "cpu"
    threads: int = 1

    def load(self) -> Recipe:
        """Return the recipe, checked.

        Raises
        ------
        ConfigurationError
            When it is not valid.
        """
        return load_recipe(self.recipe, self.settings, self.inputs)


@dataclass(frozen=True)
class Reduced:
    """What became of a task.

    Attributes
    ----------
    name, folder :
        As in the task.
    action : str
        ``new``, ``redone``, ``up to date`` or ``failed``.
    status : str
        As in results.json; ``failed`` also when nothing was written.
    checks_failed : tuple of str
        What the QC checks that failed say.
    reasons : tuple of str
        One line per stage that was redone: which, and why.
    problem : str
        What stopped it, or what is wrong beside the results, in one line.
    key : str
        Of the last product, where it is known; see `Step`.
    log : Path
        Where more is told.
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


Runner = Callable[[Callable[[Task], Reduced], Sequence[Task]], Iterable[Reduced]]
"""Calls a function with every task, anywhere and in any order; returns one result per task, as they come."""


def reduce_group(task: Task, last: str | None = None, before: Reduced | None = None) -> Reduced:
    """Bring the products of a task up to date.

    Parameters
    ----------
    last : str, optional
        The stage to stop at, for engines that send stage after stage; products appear with the recipe's
        last stage, or without `last`.
    before : Reduced, optional
        What became of the stage before; if that failed, this one is not tried.

    Returns
    -------
    Reduced
        Also for everything that can go wrong; only interruptions are raised.
    """
    if before is not None and before.failed:
        return before
    clock = time.perf_counter()
    try:
        done = _reduce(task, last)
    except Exception as error:
        done = failure(task, _told(error))
    spent = before.seconds if before is not None else 0.0
    return replace(done, seconds=round(spent + time.perf_counter() - clock, 3))


def failure(task: Task, problem: str) -> Reduced:
    """Return what a task came to that was stopped by a problem."""
    log = RunFolder(Place(task.folder).workplace).log
    return Reduced(task.name, task.folder, FAILED, "failed", problem=problem, log=log)


def planned(task: Task, recipe: Recipe) -> list[Step] | None:
    """Return what would be done about every stage; None when there are no products at all.

    Raises
    ------
    IrlosError
        When the inputs cannot be read.
    """
    if not Place(task.folder).published:
        return None
    return plan_run(recipe, task.folder, Selection())[1]


def unchanged(task: Task, steps: Sequence[Step]) -> Reduced:
    """Return what a task came to whose products are up to date; others that were begun are removed."""
    Place(task.folder).discard()
    return _ended(task, RunFolder(task.folder), UNCHANGED, key=steps[-1].key)


def _reduce(task: Task, last: str | None) -> Reduced:
    recipe, place = task.load(), Place(task.folder)
    steps = planned(task, recipe)
    if steps is not None and all(step.current for step in steps):
        return unchanged(task, steps)
    run = RunFolder(place.prepare())
    outcome = run_recipe(recipe, run.path, Selection(last=last), Resources(task.device, task.threads))
    if last in (None, recipe.stages[-1]):
        place.publish()
        run = RunFolder(task.folder)
    reasons = tuple(step.describe() for step in steps or () if not step.current)
    action = NEW if steps is None else REDONE
    return _ended(task, run, action, reasons=reasons, problem=outcome.report_error)


def _ended(task: Task, run: RunFolder, action: str, **more: Any) -> Reduced:
    """What the files of a run say about its end."""
    try:
        status = json.loads(run.results.read_text())["status"]
        checks = json.loads(run.quality.read_text())["checks"]
        failed = tuple(f"{check['stage']}: {check['message']}" for check in checks if not check["passed"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputDataError(f"{run.path}: cannot be read ({error}); remove it and run again") from error
    return Reduced(task.name, task.folder, action, status, failed, log=run.log, **more)


def _told(error: Exception) -> str:
    if isinstance(error, IrlosError):
        return next(iter(str(error).splitlines()), type(error).__name__)
    return f"unexpected {type(error).__name__}: {error}"
