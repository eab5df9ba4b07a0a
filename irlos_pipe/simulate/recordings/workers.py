"""Makes recordings in a hidden folder, in one process or several; each appears when complete."""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from irlos_pipe.files.processes import in_processes
from irlos_pipe.simulate.recordings.folder import WORK_PREFIX, SimulationFolder
from irlos_pipe.simulate.recordings.one_recording import Made, record
from irlos_pipe.simulate.recordings.planned import Planned
from irlos_pipe.simulate.recordings.truth import write_truth

LOG = logging.getLogger("irlos_pipe.run")
LOOK_S = 0.3  # between looks at the progress of the worker processes
SATURATION_NOTED = 1e-4  # fraction of values on the end of the converter that is worth a warning


@dataclass(frozen=True)
class Job:
    """One recording in the work folder; `count` jobs report their progress in one shared file."""

    planned: Planned
    work: Path
    index: int
    count: int

    @property
    def folder(self) -> Path:
        """Return the folder in which the recording is made."""
        return self.work / "data" / self.planned.name

    @property
    def spool(self) -> Path:
        """Return the file that keeps its mean images until they are read out."""
        return self.work / f"{self.index}.mean_e"

    def frames_done(self) -> np.ndarray:
        """Return the frames that each job has exposed, (count,); shared between processes."""
        path = self.work / "frames_done"
        return np.memmap(path, np.int64, "r+" if path.exists() else "w+", shape=self.count)

    def perform(self, report: Callable[[], Any] = lambda: None) -> Made:
        """Make the recording."""
        frames_done = self.frames_done()

        def show(frames: int) -> None:
            frames_done[self.index] = frames
            report()

        self.folder.mkdir(parents=True)
        return record(self.planned, self.folder, self.spool, show)


def make_all(
    planned: Sequence[Planned], target: SimulationFolder, jobs: int, progress: Callable[..., Any] | None
) -> None:
    """Make recordings; those that are complete stay when a later one fails.

    Parameters
    ----------
    planned : sequence of Planned
    target : SimulationFolder
    jobs : int
        Worker processes.
    progress : callable or None
        Makes a progress bar, see `simulate`.
    """
    if not planned:
        return
    with _work_folder(target.path) as work, _bar(planned, progress) as bar:
        tasks = [Job(one, work, index, len(planned)) for index, one in enumerate(planned)]
        frames_done = tasks[0].frames_done()

        def show() -> None:
            bar.update(int(frames_done.sum()) - bar.n)

        made = _in_turn(tasks, show) if min(jobs, len(tasks)) == 1 else _side_by_side(tasks, jobs, show)
        for task, result in made:
            _put_in_place(task, result, target)


def _in_turn(tasks: Sequence[Job], show: Callable[[], None]) -> Iterator[tuple[Job, Made]]:
    """Perform the tasks here, with one thread as worker processes have: more give other last bits."""
    for task in tasks:
        with threadpool_limits(1):
            made = task.perform(show)
        yield task, made


def _side_by_side(tasks: Sequence[Job], jobs: int, show: Callable[[], None]) -> Iterator[tuple[Job, Made]]:
    """Perform the tasks in worker processes; yields them as they are finished."""
    longest_first = sorted(tasks, key=lambda task: -task.planned.scene.frames * task.planned.scene.exposure_s)
    with in_processes(min(jobs, len(tasks)), Job.perform, [(task,) for task in longest_first]) as futures:
        owners: dict[Future, Job] = dict(zip(futures, longest_first, strict=True))
        while owners:
            done, _ = wait(owners, timeout=LOOK_S, return_when="FIRST_COMPLETED")
            show()
            yield from ((owners.pop(future), future.result()) for future in done)


def _put_in_place(task: Job, made: Made, target: SimulationFolder) -> None:
    """Show a recording under its name; its truth comes last, until then it does not count as made."""
    planned, final = task.planned, target.data(task.planned)
    target.forget(target.truth(planned))
    final.parent.mkdir(parents=True, exist_ok=True)
    if final.exists():
        final.rename(Path(tempfile.mkdtemp(dir=task.work)) / "replaced")
    task.folder.rename(final)
    write_truth(target.truth(planned), made.truth, made.wavefront_fits)
    _report(planned, made)


def _report(planned: Planned, made: Made) -> None:
    LOG.info("%s: %d frames, brightest pixel %d ADU", planned.name, planned.scene.frames, made.brightest_adu)
    values = planned.scene.frames * int(np.prod(planned.scene.window))
    if made.saturated > SATURATION_NOTED * values:
        LOG.warning("%s: %d of %d values are saturated", planned.name, made.saturated, values)


def _bar(planned: Sequence[Planned], progress: Callable[..., Any] | None) -> Any:
    """A progress bar that counts frames."""
    total = sum(one.scene.frames for one in planned)
    return progress(total=total, desc="frames") if progress else tqdm(total=total, disable=True)


@contextmanager
def _work_folder(parent: Path) -> Iterator[Path]:
    """A hidden folder on the same disk, gone at the end."""
    work = Path(tempfile.mkdtemp(prefix=WORK_PREFIX, dir=parent))
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
