"""Simulate the recordings of a spec: skip what is there, make the rest, show nothing half done."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError
from irlos_pipe.files.atomic import write_if_changed
from irlos_pipe.product.runfolder import owned_folder, require_free
from irlos_pipe.simulate.recordings.folder import SimulationFolder
from irlos_pipe.simulate.recordings.planned import Planned
from irlos_pipe.simulate.recordings.series import plan_recordings
from irlos_pipe.simulate.recordings.spec import Spec
from irlos_pipe.simulate.recordings.workers import LOG, make_all

FORCED, UP_TO_DATE = "--force", "up to date"


@dataclass(frozen=True)
class Step:
    """One recording and why it is made.

    Attributes
    ----------
    reason : str
        Why it is made; empty when it is up to date.
    """

    planned: Planned
    reason: str


def plan_simulation(spec: Spec, folder: Path, force: bool = False) -> list[Step]:
    """Return what a run of `spec` into `folder` would do; `force` makes all again. Nothing is written.

    Raises
    ------
    ConfigurationError
        When the output folder cannot be used.
    """
    target = SimulationFolder(Path(folder))
    planned = plan_recordings(spec)
    target.require_own(planned)
    require_free(target.path, (target.spec.name,))
    steps = [Step(one, FORCED if force else target.reason(one)) for one in planned]
    _require_room(target.path, sum(step.planned.size_bytes for step in steps if step.reason))
    return steps


def _require_room(folder: Path, needed_bytes: float) -> None:
    """Refuse a simulation that the disk cannot hold, before hours of work."""
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    free_bytes = shutil.disk_usage(existing).free
    if needed_bytes > free_bytes:
        raise ConfigurationError(
            f"--output {folder}: the recordings take {needed_bytes / 1e9:.1f} GB, {free_bytes / 1e9:.1f} are "
            "free; simulate fewer frames or a smaller window"
        )


def simulate(
    spec: Spec, folder: Path, force: bool = False, jobs: int = 1, progress: Callable[..., Any] | None = None
) -> list[Step]:
    """Bring the recordings of a spec up to date.

    Parameters
    ----------
    spec : Spec
    folder : Path
        Holds ``data/``, ``truth/`` and the spec with all defaults; made if it does not exist.
    force : bool
        Make recordings again that are up to date.
    jobs : int
        Worker processes; the recordings are the same to the bit for any number.
    progress : callable, optional
        Called with `total` and `desc`; makes a progress bar (tqdm) that counts frames.

    Returns
    -------
    list of Step
        What was done.

    Raises
    ------
    Locked
        When another run owns the folder.
    IrlosError
        When a recording cannot be made or written; finished ones stay.
    """
    plan_simulation(spec, folder, force)  # a mistake leaves no empty folder behind
    with owned_folder(Path(folder)), _reported_in_one_line(folder):
        target = SimulationFolder(Path(folder))
        target.remove_leftovers()
        steps = plan_simulation(spec, folder, force)
        write_if_changed(target.spec, spec.resolved_yaml().encode())
        for name in list(target.outdated([step.planned for step in steps])):
            LOG.info("%s: removed, the spec no longer has it", target.remove(name))
        for step in steps:
            LOG.info("%s: %s", step.planned.name, step.reason or UP_TO_DATE)
        make_all([step.planned for step in steps if step.reason], target, jobs, progress)
    return steps


@contextmanager
def _reported_in_one_line(folder: Path) -> Iterator[None]:
    """Turn what the system refuses into one line."""
    try:
        yield
    except OSError as error:
        if error.errno == errno.ENOSPC:
            raise IrlosError(f"{folder}: the disk is full; free some space and run again") from error
        where = error.filename or folder
        raise IrlosError(f"{where}: cannot be written: {error.strerror or error}") from error
    except BrokenProcessPool as error:
        raise IrlosError(
            "a worker process was killed, perhaps because memory ran out; finished recordings stay: "
            "run the same command to go on, with fewer --jobs"
        ) from error
    except MemoryError as error:
        raise IrlosError("out of memory; use fewer --jobs or a smaller window") from error
