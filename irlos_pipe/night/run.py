"""Run a night, or an archive of nights: what is new or out of date is reduced, the rest is left alone."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from irlos_pipe.conventions.errors import InputDataError, IrlosError, NothingToDo
from irlos_pipe.conventions.text import and_more
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.night.catalogue import Catalogue
from irlos_pipe.night.database import copied, opened
from irlos_pipe.night.description import night_of
from irlos_pipe.night.discover import dated, discover
from irlos_pipe.night.grouping import Grouping, LeftOut, Rules, group_recordings
from irlos_pipe.night.jobs import Job, jobs_of
from irlos_pipe.night.measures import read_measures
from irlos_pipe.night.page import begin_page, is_finished, write_page
from irlos_pipe.night.reduce import Reduced, Runner, Task, failure, planned, reduce_group, unchanged
from irlos_pipe.night.settings import NightSettings
from irlos_pipe.night.state import Night, Ran
from irlos_pipe.night.trend import alarm_text, make_trend
from irlos_pipe.night.trend_db import points, store, stored_key, verdicts
from irlos_pipe.pipeline import Step
from irlos_pipe.pipeline.runlog import RUN, TRACE, written_to
from irlos_pipe.product.runfolder import owned_folder, require_outside_inputs

LOG_NAME = "night.log"
NO_RECIPE = "no recipe serves groups of kind {0}; give one with --recipe {0}=PATH"


@dataclass(frozen=True)
class Order:
    """What is to be run.

    Attributes
    ----------
    folders : sequence of Path
        Searched for recordings.
    tree : Path
        Where everything goes.
    since : str
        First night to look at, ISO date; all if empty.
    """

    folders: Sequence[Path]
    tree: Path
    settings: NightSettings
    since: str = ""
    device: str = "cpu"


def run_night(order: Order, runner: Runner) -> Ran:
    """Bring the products of all recordings under the folders up to date, and tell of every night.

    Raises
    ------
    NothingToDo
        When there is no recording, or none that a recipe serves; the page of the night says so.
    Locked
        When another run owns the tree.
    IrlosError
        When the whole run cannot go on; pages say what stopped it, finished products stay.
    """
    require_outside_inputs(order.tree, {"NIGHT_DIR": order.folders})
    with owned_folder(order.tree), written_to(order.tree / LOG_NAME):
        ran = Ran()
        with _told_on_pages(order, ran):
            with opened(order.tree) as connection:
                _find(order, ran, Catalogue(connection))
            _reduce(order, ran, runner)
            _judge(order, ran)
    return ran


def plan_night(order: Order) -> tuple[list[tuple[Job, list[Step] | None]], list[str]]:
    """Return every job with what would be done about its stages (None: all of them); nothing is written.

    Returns
    -------
    plan : list of (Job, list of Step or None)
    failures : list of str
        What could not be reduced, one line each.

    Raises
    ------
    NothingToDo, IrlosError
        As in `run_night`.
    """
    require_outside_inputs(order.tree, {"NIGHT_DIR": order.folders})
    ran = Ran()
    with copied(order.tree) as connection:
        _find(order, ran, Catalogue(connection))
    jobs = [job for night in ran.nights.values() for job in night.jobs]
    plan = [(job, planned(job.task, job.task.load())) for job in jobs]
    return plan, [failure for night in ran.nights.values() for failure in night.failures]


def _find(order: Order, ran: Ran, catalogue: Catalogue) -> None:
    """Fill in what there is."""
    settings = order.settings
    found = discover(order.folders, settings.acquisition, load_instrument(settings.instrument), catalogue)
    recordings = [one for one in found.recordings if one.night >= order.since]
    for one in recordings:
        ran.night(one.night).recordings.append(one)
    for one in found.unusable:
        if one.night >= order.since:
            RUN.info("left out: %s", one.problem)
            ran.night(one.night).unusable.append(one)
    rules = Rules(60 * settings.series_gap_min, settings.calibration_nights)
    _sort(order, ran, group_recordings(recordings, rules, catalogue.still_there()))
    if not any(night.jobs or night.failures for night in ran.nights.values()):
        raise NothingToDo(_nothing(order, ran))


def _sort(order: Order, ran: Ran, grouping: Grouping) -> None:
    """Give every night its jobs, and what is left out."""
    for job in jobs_of(grouping.groups, order.settings, order.tree, order.device):
        ran.night(job.group.night).jobs.append(job)
    unserved = [one for one in grouping.groups if not order.settings.recipes_of(one.kind)]
    for left in (*grouping.left_out, *(LeftOut(one.first, NO_RECIPE.format(one.kind)) for one in unserved)):
        ran.night(left.recording.night).left_out.append(left)


def _nothing(order: Order, ran: Ran) -> str:
    where = ", ".join(map(str, order.folders)) + (f" since {order.since}" if order.since else "")
    left_out = [one for night in ran.nights.values() for one in night.left_out]
    if left_out:
        first = left_out[0]
        return f"{where}: nothing to reduce; {first.recording.name}: {first.reason}{and_more(left_out)}"
    return f"{where}: no recordings"


def _reduce(order: Order, ran: Ran, runner: Runner) -> None:
    """Work on what is not up to date; one that fails does not stop the others."""
    jobs = {job.task.name: job for night in ran.nights.values() for job in night.jobs}
    for name, reduced in {name: _as_it_is(job.task) for name, job in jobs.items()}.items():
        if reduced is not None:
            _take(order, ran, jobs[name], reduced)
    todo = [job.task for night in ran.nights.values() for job in night.unfinished]
    for night in ran.nights.values():
        if night.unfinished:
            begin_page(order.tree, night)
    for number, reduced in enumerate(runner(reduce_group, todo) if todo else (), 1):
        RUN.info("%d of %d: %s", number, len(todo), told(reduced))
        _take(order, ran, jobs[reduced.name], reduced)


def _as_it_is(task: Task) -> Reduced | None:
    """What can be said without work: that all is up to date, or that it cannot be known."""
    try:
        steps = planned(task, task.load())
        current = steps is not None and all(step.current for step in steps)
        return unchanged(task, steps) if current else None
    except IrlosError as error:
        return failure(task, str(error).splitlines()[0])


def _take(order: Order, ran: Ran, job: Job, reduced: Reduced) -> None:
    """Note what became of a job, and its numbers unless they are known."""
    try:
        if not reduced.failed:
            _store(order.tree, job, reduced)
    except InputDataError as error:
        reduced = replace(reduced, problem=str(error))
    ran.night(job.group.night).reduced[reduced.name] = reduced


def _store(tree: Path, job: Job, reduced: Reduced) -> None:
    with opened(tree) as connection:
        if not reduced.key or reduced.key != stored_key(connection, reduced.name):
            measured = read_measures(reduced.folder, job.group.kind)
            store(connection, reduced.name, job.group, job.task.recipe.stem, measured)


def _judge(order: Order, ran: Ran) -> None:
    """Note what left its band, and write the pages of nights with news."""
    with opened(order.tree) as connection:
        trend = make_trend(points(connection), verdicts(connection), order.settings.band)
    for date, night in ran.nights.items():
        night.alarms = [alarm_text(*alarm) for alarm in trend.alarms(date)]
        if night.changed or not is_finished(order.tree, date):
            write_page(order.tree, night, trend.until(date))


def told(reduced: Reduced) -> str:
    """Return one line on a job for people."""
    why = "; ".join(reduced.reasons) or reduced.problem
    return f"{reduced.name}: {reduced.action}" + (f": {why}" if why else f" in {reduced.seconds:.1f} s")


@contextmanager
def _told_on_pages(order: Order, ran: Ran) -> Iterator[None]:
    """Say on the page of every unfinished night what stopped the run."""
    try:
        yield
    except BaseException as error:
        TRACE.info("stopped: %s", error, exc_info=not isinstance(error, (IrlosError, KeyboardInterrupt)))
        for night in _not_told(order, ran):
            if isinstance(error, NothingToDo):
                night.nothing = str(error)
            else:
                night.stopped = _why(error)
            with suppress(IrlosError):  # the first error is the one to tell
                write_page(order.tree, night, None)
        raise


def _not_told(order: Order, ran: Ran) -> list[Night]:
    """Nights whose page is not written: all in work, or the one that was asked for."""
    if not ran.nights:
        last = order.folders[0]
        return [Night(dated(last) or night_of(time.time()))]
    return [night for date, night in ran.nights.items() if night.changed or not is_finished(order.tree, date)]


def _why(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted; finished products stay, run the same command to go on"
    return str(error) if isinstance(error, IrlosError) else f"unexpected {type(error).__name__}: {error}"
