"""Tasks, a recipe on the recordings of a group each, and working on one; its errors concern it alone.

Products of a task can be read until all the new ones are complete: work is done in a hidden folder,
``.<recipe>.new``; when that is complete it takes the place of ``<recipe>`` by two renames, which any disk can
do. A run that is killed between them is completed by the next one.
"""

import json
import os
import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing import parent_process
from pathlib import Path

from irlos_pipe.conventions.errors import ConfigurationError, InputDataError, IrlosError
from irlos_pipe.files.json import jsonable
from irlos_pipe.files.processes import TookTooLong, time_limit
from irlos_pipe.files.yaml import load_yaml
from irlos_pipe.night.grouping import Group
from irlos_pipe.night.settings import NightSettings
from irlos_pipe.pipeline import Resources, Selection, Step, plan_run, run_recipe
from irlos_pipe.product.results import read_run_results
from irlos_pipe.product.runfolder import EARLIER, LOCK_NAME, RunFolder
from irlos_pipe.recipe import Recipe, load_recipe

NEW, REDONE, UNCHANGED, FAILED = "new", "redone", "up to date", "failed"


@dataclass(frozen=True)
class Task:
    """A recipe and the recordings to run it on: small, and the same in any process on any machine."""

    name: str  # ``<night>/<group>/<recipe>``, unique in the tree
    folder: Path  # where the products are found when they are complete, see `PublishedRun`
    # recipe, settings, inputs: arguments of `load_recipe`.
    recipe: Path
    settings: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    device: str = "cpu"
    limit_s: float = 0.0  # longest time that it may take [s]; no limit if 0

    def load(self) -> Recipe:
        return load_recipe(self.recipe, self.settings, self.inputs)


@dataclass(frozen=True)
class Job:
    """A task and the group whose recordings it reduces."""

    group: Group
    task: Task


@dataclass(frozen=True)
class Reduced:
    """The outcome of a task."""

    name: str
    folder: Path
    action: str  # ``new``, ``redone``, ``up to date`` or ``failed``: there are no new products
    status: str = "ok"  # as in results.json; ``failed`` also when nothing was written
    checks_failed: tuple[str, ...] = ()  # messages of the QC checks that failed
    reasons: tuple[str, ...] = ()  # one line per stage that was redone: which, and why
    problem: str = ""  # the error that stopped it, or a problem next to the results, in one line
    key: str = ""  # key of the last product, where it is known; see `Step`
    log: Path = Path()
    seconds: float = 0.0  # wall time [s]

    @property
    def failed(self) -> bool:
        return self.action == FAILED


Work = Callable[..., Reduced]  # `reduce_group`, or what stands in for it
Runner = Callable[[Work, Sequence[Task]], Iterable[Reduced]]  # one outcome per task, as they are ready


def jobs_of(groups: Iterable[Group], settings: NightSettings, tree: Path, device: str = "cpu") -> list[Job]:
    """Return one job per group and recipe, whether or not its products are up to date.

    The `settings` have the recipes by kind of the `groups`, and changes of their settings; products go to
    ``tree/<night>/<group>/<recipe>`` of the `tree`; `device` is ``cpu``, ``cuda`` or ``auto``.

    Raises `ConfigurationError` when a recipe is not valid, or declares an input that its kind of group does
    not have.
    """
    tree = tree.absolute()  # tasks may be worked on elsewhere
    jobs = []
    for group in groups:
        for recipe in settings.recipes_of(group.kind):
            name = f"{group.night}/{group.name}/{recipe.stem}"
            changed, inputs = _settings(recipe, settings), _inputs(recipe, group)
            limit_s = 60 * settings.limit_min
            jobs.append(Job(group, Task(name, tree / name, recipe, changed, inputs, device, limit_s)))
    for job in {job.task.recipe: job for job in jobs}.values():
        job.task.load()
    return jobs


def calibrates(recipe: Path) -> bool:
    """Return whether a `recipe` has the stage `calibrate`, whose quality a calibration is judged by."""
    return "calibrate" in (load_yaml(recipe)[0].get("stages") or ())


def _inputs(recipe: Path, group: Group) -> tuple[str, ...]:
    """``NAME=PATH`` for every input of the recipe."""
    declared = load_yaml(recipe)[0].get("inputs")
    names = list(declared) if isinstance(declared, dict) else []
    for name in names:
        if name not in group.inputs:
            offered = " and ".join(f"'{one}'" for one in group.inputs)
            raise ConfigurationError(
                f"{recipe}: needs input '{name}', but a group of kind '{group.kind}' has only "
                f"{offered}; choose another recipe with --recipe {group.kind}=PATH"
            )
    return tuple(f"{name}={recording.path}" for name in names for recording in group.inputs[name])


def _settings(recipe: Path, settings: NightSettings) -> tuple[str, ...]:
    """``stage.key=VALUE`` for every setting of the recipe that is changed."""
    changed = dict(settings.settings.get(recipe.stem, {}))
    keys = settings.acquisition.model_dump(mode="json", exclude_none=True)
    if keys:
        changed["ingest.acquisition"] = keys
    return tuple(f"{key}={json.dumps(jsonable(value))}" for key, value in changed.items())


def reduce_group(task: Task, last: str | None = None, before: Reduced | None = None) -> Reduced:
    """Bring the products of a `task` up to date; an error is an outcome, too, only interruptions are raised.

    Engines that run stage after stage give the stage to stop at, `last`, and the outcome of the stage
    `before`; if that failed, this one is not tried. Products are published with the recipe's last stage, or
    without `last`.
    """
    if before is not None and before.failed:
        return before
    start = time.perf_counter()
    try:
        with time_limit(task.limit_s, "the reduction", kill=parent_process() is not None):
            reduced = _reduce(task, last)
    except (TookTooLong, IrlosError) as error:
        reduced = failure(task, next(iter(str(error).splitlines()), type(error).__name__))
    except Exception as error:
        reduced = failure(task, f"unexpected {type(error).__name__}: {error}")
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
    """Return the plan of every stage of the `recipe` of a `task`; None when there are no products at all."""
    return plan_run(recipe, task.folder, Selection())[1] if PublishedRun(task.folder).published else None


def unchanged(task: Task, steps: Sequence[Step] | None) -> Reduced | None:
    """Return the outcome if all planned `steps` are up to date, else None; removes an unfinished set then."""
    if steps is None or not all(step.current for step in steps):
        return None
    published = PublishedRun(task.folder)
    published.remove(published.work_folder)
    return replace(_outcome(task, RunFolder(task.folder), UNCHANGED), key=steps[-1].key)


def _reduce(task: Task, last: str | None) -> Reduced:
    recipe, published = task.load(), PublishedRun(task.folder)
    steps = planned(task, recipe)
    current = unchanged(task, steps)
    if current is not None:
        return current
    run = RunFolder(published.prepare())
    outcome = run_recipe(recipe, run.path, Selection(last=last), Resources(task.device))
    if last in (None, recipe.stages[-1]):
        published.publish()
        run = RunFolder(task.folder)
    reasons = tuple(step.describe() for step in steps or () if not step.current)
    reduced = _outcome(task, run, NEW if steps is None else REDONE)
    return replace(reduced, reasons=reasons, problem=outcome.report_error)


def _outcome(task: Task, run: RunFolder, action: str) -> Reduced:
    try:
        status = read_run_results(run.results).status
        checks = json.loads(run.quality.read_bytes())["checks"]
        failed = tuple(f"{one['stage']}: {one['message']}" for one in checks if not one["passed"])
    except (OSError, ValueError, TypeError, LookupError, InputDataError) as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise InputDataError(f"{run.path}: cannot be read ({reason}); remove it and run again") from error
    return Reduced(task.name, task.folder, action, status, failed, log=run.log)


EARLIER_SLOTS = ("a", "b")  # folders to one of which `path` was a link in trees of earlier versions


@dataclass(frozen=True)
class PublishedRun:
    """Where the latest complete products of a reduction are found, and where the next ones are made."""

    path: Path

    @property
    def published(self) -> bool:
        """Whether there is a complete set of products, made by a run and not by somebody else."""
        linked = self.path.is_symlink() and self.path.is_dir()  # moved away, or by an earlier version
        return linked or RunFolder(self.path).recipe.is_file()

    @property
    def work_folder(self) -> Path:
        """The folder of the next set of products; it may not exist, or hold what an interruption left."""
        return self._hidden("new")

    def prepare(self) -> Path:
        """Return the work folder; it starts with the published products unless work has begun there.

        Raises `IrlosError` when something else has this name, a folder above it is a link, or the folder
        cannot be written.
        """
        for folder in (self.path.parent.parent, self.path.parent):
            if folder.is_symlink():
                raise IrlosError(f"{folder}: is a link, through which nothing is written; put a folder there")
        if self.path.exists() and not self.published:
            raise IrlosError(f"{self.path}: is in the way; it was not made by irlos night, move it elsewhere")
        try:
            self._fill_work_folder()
        except OSError as error:
            raise IrlosError(f"{self.path}: cannot be written: {error.strerror or error}") from error
        return self.work_folder

    def publish(self) -> None:
        """Replace the published products by those of the work folder, and remove the old ones.

        Raises `IrlosError` when they cannot be replaced; both sets are then still there.
        """
        old = self._hidden("old")
        try:
            if os.path.lexists(self.path):
                self.remove(old)
                os.rename(self.path, old)
            os.rename(self.work_folder, self.path)
        except OSError as error:
            if not os.path.lexists(self.path):
                with suppress(OSError):
                    os.rename(old, self.path)
            raise IrlosError(
                f"{self.path}: cannot be replaced by the new products ({error.strerror or error}); close what"
                " reads it, the next irlos night tries it again"
            ) from error
        for ending in ("old", *EARLIER_SLOTS):
            self.remove(self._hidden(ending))

    def _fill_work_folder(self) -> None:
        """Fill an absent work folder in one step, so that a half filled one is never continued."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self._hidden("old").exists() and not self.published and self.work_folder.exists():
            self.publish()  # a run was killed between the two renames
        if self.work_folder.exists() or not self.published:
            return
        copy = self._hidden("copy")
        self.remove(copy)
        others = shutil.ignore_patterns(f"{LOCK_NAME}*", EARLIER)
        shutil.copytree(self.path.resolve(), copy, ignore=others, copy_function=_link_or_copy)
        os.rename(copy, self.work_folder)

    def remove(self, folder: Path) -> None:
        """Rename before removing: a half removed folder must not look like a half filled one."""
        rubbish = self._hidden("rubbish")
        shutil.rmtree(rubbish, ignore_errors=True)
        if folder.is_symlink():
            folder.unlink()
        elif folder.exists():
            os.rename(folder, rubbish)
            shutil.rmtree(rubbish, ignore_errors=True)

    def _hidden(self, ending: str) -> Path:
        return self.path.with_name(f".{self.path.name}.{ending}")


def _link_or_copy(source: str, target: str) -> None:
    """Products are never changed in place, so both sets may share a file; the log grows and must not."""
    if Path(source).name == RunFolder(Path(source).parent).log.name:
        shutil.copy2(source, target)
        return
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
