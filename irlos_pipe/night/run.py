"""Run a night or an archive of nights: reduce what is new or out of date, leave the rest alone."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from irlos_pipe.conventions.errors import InputDataError, IrlosError, NothingToDo
from irlos_pipe.conventions.text import and_more
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.night import reduce
from irlos_pipe.night.database import NAME, Database, copied, opened
from irlos_pipe.night.grouping import Group, group_recordings
from irlos_pipe.night.numbers import read_measurements
from irlos_pipe.night.page import FINISHED, write_index, write_page
from irlos_pipe.night.recordings import LeftOut, date_in_path, discover, known_recordings, night_of
from irlos_pipe.night.settings import NightSettings
from irlos_pipe.night.state import Night, RunState, page_path, read_acknowledged
from irlos_pipe.night.trend import make_trend
from irlos_pipe.pipeline import Step
from irlos_pipe.pipeline.runlog import RUN, TRACE, written_to
from irlos_pipe.product.runfolder import owned_folder, require_free, require_outside_inputs
from irlos_pipe.report.text import plural

LOG_NAME = "night.log"
RAMP = "defocus_ramp"
OF_A_TREE = (LOG_NAME, NAME, "night_*.html")
NO_RECIPE = "no recipe for groups of kind {0}; give one with --recipe {0}=PATH"


@dataclass(frozen=True)
class Request:
    """What is to be run: recordings in `folders`, results into the `tree`."""

    folders: Sequence[Path]
    tree: Path
    settings: NightSettings
    since: str = ""  # first night to look at, ISO date; all if empty
    device: str = "cpu"
    acknowledge: bool = False  # what is wrong is known from now on, and not reported again


def run_night(request: Request, runner: reduce.Runner) -> RunState:
    """Bring the products of all recordings of a `request` up to date, and write the page of every night.

    The `runner` says where tasks are worked on, see `engines`. Ramps come last, when it is known which
    calibrations can serve them.

    Raises `NothingToDo` when there is no recording, or no recipe for any, which the page of the night says;
    `Locked` when another run owns the tree; `IrlosError` when the whole run cannot go on, where the pages say
    what stopped it and finished products stay.
    """
    _require_usable(request)
    with owned_folder(request.tree), written_to(request.tree / LOG_NAME):
        state = RunState(acknowledged=read_acknowledged(request.tree))
        with _errors_on_pages(request, state):
            with opened(request.tree) as database:
                _find(request, state, database)
            recordings = sum(len(night.recordings) for night in state.nights.values())
            RUN.info("%s of %s", plural(recordings, "recording"), plural(len(state.nights), "night"))
            _work_on(request, state, runner, lambda job: job.group.kind != "ramp")
            _choose_calibrations(request, state)
            _work_on(request, state, runner, lambda job: job.group.kind == "ramp")
            _write_pages(request, state)
    return state


def plan_night(request: Request) -> tuple[RunState, list[tuple[reduce.Job, list[Step] | None]]]:
    """Return what is found of a `request`, and every job with the plan of its stages; nothing is written.

    There is no plan where there are no products: all stages would be run. Errors are those of `run_night`.
    """
    _require_usable(request)
    state = RunState()
    with copied(request.tree) as database:
        _find(request, state, database)
    jobs = [job for night in state.nights.values() for job in night.jobs]
    return state, [(job, reduce.planned(job.task, job.task.load())) for job in jobs]


def _require_usable(request: Request) -> None:
    require_free(request.tree, OF_A_TREE)
    require_outside_inputs(request.tree, {"NIGHT_DIR": request.folders})


def _find(request: Request, state: RunState, database: Database) -> None:
    """Find the recordings, and give every night its jobs."""
    settings = request.settings
    recordings, left_out = discover(
        request.folders,
        settings.acquisition,
        load_instrument(settings.instrument),
        database,
        limit_s=60 * settings.limit_min,
    )
    for recording in recordings:
        if recording.night >= request.since:
            state.night(recording.night).recordings.append(recording)
    for one in left_out:
        if one.recording.night >= request.since:
            what = "left out" if one.found_as == "unusable" else one.recording.path
            RUN.info("%s: %s", what, one.reason)
            state.leave_out([one])
    for night in state.nights.values():
        for line in night.guessed:
            RUN.info(line)
    _assign(request, state, *_grouped(request, state, database))
    if not any(night.jobs or night.failures or night.known for night in state.nights.values()):
        raise NothingToDo(_nothing_text(request, state))


def _assign(request: Request, state: RunState, groups: Sequence[Group], left_out: Sequence[LeftOut]) -> None:
    """Give every night its jobs, and what is left out."""
    for job in reduce.jobs_of(groups, request.settings, request.tree, request.device):
        state.night(job.group.night).jobs.append(job)
    without = [one for one in groups if not request.settings.recipes_of(one.kind)]
    state.leave_out([*left_out, *(LeftOut(one.first, NO_RECIPE.format(one.kind)) for one in without)])


def _grouped(
    request: Request, state: RunState, database: Database, broken: Mapping[str, str] | None = None
) -> tuple[list[Group], list[LeftOut]]:
    """The groups, ramps with calibrations that neither failed by the database nor are `broken`."""
    settings = request.settings
    judging = [recipe.stem for recipe in settings.recipes_of("calibration") if reduce.calibrates(recipe)]
    failed = database.failed_calibrations(judging) | dict(broken or {})
    recordings = [one for night in state.nights.values() for one in night.recordings]
    return group_recordings(recordings, settings, known_recordings(database), failed)


def _choose_calibrations(request: Request, state: RunState) -> None:
    """Give the ramps their calibrations again: those that failed just now no longer serve."""
    broken = {
        job.task.name.rpartition("/")[0]: "could not be reduced"
        for night in state.nights.values()
        for job in night.jobs
        if job.group.kind == "calibration"
        and reduce.calibrates(job.task.recipe)
        and night.reduced[job.task.name].failed
    }
    with opened(request.tree) as database:
        groups, left_out = _grouped(request, state, database, broken)
    ramps = [one for one in groups if one.kind == "ramp"]
    for night in state.nights.values():
        night.jobs = [job for job in night.jobs if job.group.kind != "ramp"]
        night.left_out = [one for one in night.left_out if one.found_as or one.recording.role != RAMP]
    _assign(request, state, ramps, [one for one in left_out if one.recording.role == RAMP])
    for group in ramps:
        RUN.info("%s/%s: calibration %s", group.night, group.name, group.choice)


def _nothing_text(request: Request, state: RunState) -> str:
    where = ", ".join(map(str, request.folders)) + (f" since {request.since}" if request.since else "")
    left_out = [one for night in state.nights.values() for one in night.not_reduced]
    if left_out:
        first = left_out[0]
        return f"{where}: nothing to reduce; {first.recording.name}: {first.reason}{and_more(left_out)}"
    return f"{where}: no recordings"


def _work_on(
    request: Request, state: RunState, runner: reduce.Runner, requested: Callable[[reduce.Job], bool]
) -> None:
    """Work on the jobs that are `requested` and not up to date; one that fails does not stop others."""
    jobs = {job.task.name: job for night in state.nights.values() for job in night.jobs if requested(job)}
    for job in jobs.values():  # what is up to date or cannot be planned needs no work
        try:
            current = reduce.unchanged(job.task, reduce.planned(job.task, job.task.load()))
        except IrlosError as error:
            current = reduce.failure(job.task, str(error).splitlines()[0])
        if current is not None:
            _record(request, state, job, current)
    todo = []
    for night in state.nights.values():
        if tasks := [job.task for job in night.unfinished if requested(job)]:
            write_page(request.tree, night, None, running=True)
            todo += tasks
    if jobs:
        RUN.info("%s, %d of them up to date", plural(len(jobs), "reduction"), len(jobs) - len(todo))
    for number, reduced in enumerate(runner(reduce.reduce_group, todo) if todo else (), 1):
        why = "; ".join(reduced.reasons) or reduced.problem
        what = reduced.action + (f": {why}" if why else f" in {reduced.seconds:.1f} s")
        RUN.info("%d of %d: %s: %s", number, len(todo), reduced.name, what)
        _record(request, state, jobs[reduced.name], reduced)


def _record(request: Request, state: RunState, job: reduce.Job, reduced: reduce.Reduced) -> None:
    """Keep the outcome of a job, and store its numbers unless they are stored."""
    group, first = job.group, job.group.first
    try:
        if not reduced.failed:
            with opened(request.tree) as database:
                if not reduced.key or reduced.key != database.run_key(reduced.name):
                    head = (reduced.name, group.night, group.kind, job.task.recipe.stem)
                    of_first = (first.start_unix_s, first.configuration, first.target)
                    measured = read_measurements(reduced.folder, group.kind)
                    database.store_run((*head, *of_first), measured)
    except InputDataError as error:
        reduced = replace(reduced, problem=str(error))
    state.night(group.night).reduced[reduced.name] = reduced


def _write_pages(request: Request, state: RunState) -> None:
    """Find the numbers that left their band, and write the pages of nights that changed."""
    with opened(request.tree) as database:
        trend = make_trend(database.points(), database.verdicts(), request.settings.band)
        reductions = database.reductions()
    for date, night in state.nights.items():
        night.alarms = trend.alarms(date)
    if request.acknowledge:
        state.acknowledge(request.tree)
    for date, night in state.nights.items():
        if _needs_page(request, night):
            write_page(request.tree, night, trend.until(date))
    write_index(request.tree, reductions)


def _needs_page(request: Request, night: Night) -> bool:
    page = page_path(request.tree, night.date)  # it may be that of a run that was killed or stopped
    return night.changed or not (page.is_file() and FINISHED.encode() in page.read_bytes())


@contextmanager
def _errors_on_pages(request: Request, state: RunState) -> Iterator[None]:
    """Write on the page of every unfinished night what stopped the run.

    If no night is known, it is that which the first folder is named after.
    """
    try:
        yield
    except BaseException as error:
        TRACE.info("stopped: %s", error, exc_info=not isinstance(error, (IrlosError, KeyboardInterrupt)))
        nights = [one for one in state.nights.values() if _needs_page(request, one)]
        if not state.nights:
            nights = [Night(date_in_path(request.folders[0]) or night_of(time.time()))]
        for night in nights:
            if isinstance(error, NothingToDo):
                night.nothing = str(error)
            else:
                night.stopped = _reason(error)
            with suppress(IrlosError):  # the first error is the one to report
                write_page(request.tree, night, None)
        raise


def _reason(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted; finished products stay, run the same command again to continue"
    return str(error) if isinstance(error, IrlosError) else f"unexpected {type(error).__name__}: {error}"
