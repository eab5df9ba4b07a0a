"""Simulate the recordings of a spec: skip what is there, make the rest, show nothing half done."""

from __future__ import annotations

import errno
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError
from irlos_pipe.files.atomic import write_bytes, write_if_changed
from irlos_pipe.files.json import changed_values, json_text
from irlos_pipe.product.runfolder import owned_folder, require_free
from irlos_pipe.simulate.recordings.files import DOUBLE, Planned
from irlos_pipe.simulate.recordings.making import LOG, WORK_PREFIX, Job, Made, made_from, make_all
from irlos_pipe.simulate.recordings.series import plan_recordings
from irlos_pipe.simulate.recordings.spec import Spec

FORCED, UP_TO_DATE = "--force", "up to date"
MAX_REASONS = 3
KINDS = ("recording", "scene")  # sections whose name means nothing to a reader
SATURATION_NOTED = 1e-4  # fraction of values on the end of the converter that is worth a warning


@dataclass(frozen=True)
class Step:
    """One recording, and the `reason` why it is made; empty when it is up to date."""

    planned: Planned
    reason: str


@dataclass(frozen=True)
class SimulationFolder:
    """The folder of a simulation: where data and truth lie, and what of it is still good."""

    path: Path

    @property
    def spec(self) -> Path:
        """The spec with every default made explicit; it contains the truth, so it lies outside the data."""
        return self.path / "simulation.resolved.yaml"

    def data(self, planned: Planned) -> Path:
        """Folder of a recording; it holds nothing else."""
        return self.path / "data" / planned.name

    def truth(self, planned: Planned) -> Path:
        """Path of the truth files of a recording, without suffix."""
        name, stem = planned.name, planned.file_stem
        own = name if name.rpartition("/")[2] == stem else f"{name}/{stem}"
        return self.path / "truth" / own.replace("/", DOUBLE)

    def reason(self, planned: Planned) -> str:
        """Why a recording has to be made; empty when it is there, of the same spec and seed."""
        before = _read_made_from(self.truth(planned))
        if before is None or not self.data(planned).is_dir():
            return "not there yet"
        return changes(before, made_from(planned))

    def outdated(self, planned: Sequence[Planned]) -> Iterator[str]:
        """Truth files, without ending, of recordings that a series of the spec no longer has."""
        current = {self.truth(one).name for one in planned}
        sections = {one.name.partition("/")[0] for one in planned}
        for path in sorted((self.path / "truth").glob("*.json")):
            name = path.name.removesuffix(".json")
            if name not in current and name.partition(DOUBLE)[0] in sections:
                yield name

    def remove(self, truth_name: str) -> str:
        """Remove the truth and the data of a recording; returns its name."""
        truth = self.path / "truth" / truth_name
        before = _read_made_from(truth)
        name = before["recording"]["name"] if before else truth_name.replace(DOUBLE, "/")
        _forget(truth)
        data = (self.path / "data").resolve()
        if data in (data / name).resolve().parents:  # whoever changed the truth may have named any folder
            shutil.rmtree(data / name, ignore_errors=True)
        return name

    def put(self, job: Job, made: Made) -> None:
        """Show what a `job` has `made` under its name; the truth comes last, until then it is not made."""
        final, truth = self.data(job.planned), self.truth(job.planned)
        _forget(truth)
        final.parent.mkdir(parents=True, exist_ok=True)
        if final.exists():
            final.rename(Path(tempfile.mkdtemp(dir=job.work)) / "replaced")
        job.folder.rename(final)
        truth.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(truth.with_name(f"{truth.name}_wavefront.fits"), made.wavefront_fits)
        write_bytes(truth.with_name(f"{truth.name}.json"), json_text(made.truth).encode())


def changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Name the first few values in which `old` and `new` differ; empty when none does."""
    names = [".".join(part for part in name if part not in KINDS) for name in changed_values(old, new)]
    more = f" and {len(names) - MAX_REASONS} more" if len(names) > MAX_REASONS else ""
    return f"changed: {', '.join(names[:MAX_REASONS])}{more}" if names else ""


def _read_made_from(truth: Path) -> dict[str, Any] | None:
    """What a recording was made from; None when it is not there or cannot be read."""
    try:
        return json.loads(truth.with_name(f"{truth.name}.json").read_text())["simulation"]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _forget(truth: Path) -> None:
    for suffix in (".json", "_wavefront.fits"):
        truth.with_name(truth.name + suffix).unlink(missing_ok=True)


def plan_simulation(spec: Spec, folder: Path, force: bool = False) -> list[Step]:
    """Return what a run of `spec` into `folder` would do; `force` makes all again. Nothing is written.

    Raises `ConfigurationError` when the output folder cannot be used, or has data that this command did not
    make.
    """
    target = SimulationFolder(Path(folder))
    planned = plan_recordings(spec)
    for one in planned:
        if target.data(one).exists() and not target.spec.is_file():
            raise ConfigurationError(
                f"{target.data(one)}: is there, but was not made by irlos simulate; choose another --output"
            )
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
    """Bring the recordings of a spec up to date, and return what was done.

    The `folder`, made if it does not exist, holds ``data/``, ``truth/`` and the spec with all defaults. With
    `force`, recordings that are up to date are made again. They are the same to the bit for any number of
    worker processes (`jobs`). `progress` is called with `total` and `desc`, and makes a progress bar (tqdm)
    that counts frames.

    Raises `Locked` when another run owns the folder, and `IrlosError` when a recording cannot be made or
    written; finished ones stay.
    """
    plan_simulation(spec, folder, force)  # a mistake leaves no empty folder behind
    with owned_folder(Path(folder)), _reported_in_one_line(folder):
        target = SimulationFolder(Path(folder))
        for killed in target.path.glob(f"{WORK_PREFIX}*"):
            shutil.rmtree(killed, ignore_errors=True)
        steps = plan_simulation(spec, folder, force)
        write_if_changed(target.spec, spec.resolved_yaml().encode())
        for name in list(target.outdated([step.planned for step in steps])):
            LOG.info("%s: removed, the spec no longer has it", target.remove(name))
        for step in steps:
            LOG.info("%s: %s", step.planned.name, step.reason or UP_TO_DATE)
        due = [step.planned for step in steps if step.reason]
        with closing(make_all(due, target.path, jobs, progress)) as finished:
            for job, made in finished:
                target.put(job, made)
                _log(job.planned, made)
    return steps


def _log(planned: Planned, made: Made) -> None:
    LOG.info("%s: %d frames, brightest pixel %d ADU", planned.name, planned.scene.frames, made.brightest_adu)
    values = planned.scene.frames * int(np.prod(planned.scene.window))
    if made.saturated > SATURATION_NOTED * values:
        LOG.warning("%s: %d of %d values are saturated", planned.name, made.saturated, values)


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


def plan_rows(steps: Sequence[Step]) -> list[tuple[str, ...]]:
    """Return one row of text for each of `steps`: name, what is recorded, photons, size, what is done."""
    rows: list[tuple[str, ...]] = []
    for step in steps:
        scene = step.planned.scene
        what = (
            f"{scene.frames} x {scene.exposure_s:g} s",
            f"m_J {scene.mag_j:g}",
            f"{scene.photons:.2g} photons/frame",
            f"{step.planned.size_bytes / 1e6:.2g} MB",
        )
        done = ("simulate", step.reason) if step.reason else ("skip", UP_TO_DATE)
        rows.append((step.planned.name, *what, *done))
    return rows


def where_text(spec: Spec, folder: Path) -> str:
    """Return where in `folder` data and truth lie, one line per section of the `spec`."""
    width = max(len("truth"), *map(len, spec.recordings))
    places = {name: folder / "data" / name for name in spec.recordings} | {"truth": folder / "truth"}
    return "\n".join(f"{name:<{width}}  {path}" for name, path in places.items())
