"""Simulate the recordings of a spec: skip what is there, make the rest, show nothing half done."""

import errno
import json
import logging
import shutil
import tempfile
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from irlos_pipe.conventions.errors import ConfigurationError, IrlosError
from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.files.atomic import write_bytes, write_if_changed
from irlos_pipe.files.json import changed_values, json_text, jsonable
from irlos_pipe.files.processes import in_processes
from irlos_pipe.product.runfolder import owned_folder, require_free
from irlos_pipe.simulate.exposure import Wavefronts, exposures, static_zernike_nm, telescope_of
from irlos_pipe.simulate.readout import Readout
from irlos_pipe.simulate.recordings.files import DOUBLE, Planned, write_files
from irlos_pipe.simulate.recordings.spec import Spec, plan_recordings

LOG = logging.getLogger("irlos_pipe.run")
VERSION = 2  # of the simulator; raised when the same spec and seed give other data or another truth
DETECTOR_STREAM = 1  # child of the scene's seed; the wavefront has its own
WORK_PREFIX = ".simulating-"
LOOK_S = 0.3  # interval at which the progress of the worker processes is read

FORCED, UP_TO_DATE = "--force", "up to date"
MAX_REASONS = 3
KINDS = ("recording", "scene")  # sections whose name means nothing to a reader
SATURATION_NOTED = 1e-4  # fraction of values on the end of the converter that is worth a warning


@dataclass(frozen=True)
class Made:
    truth: dict[str, Any]  # content of its truth file
    wavefront_fits: bytes
    brightest_adu: int  # highest value of all frames
    saturated: int  # values on the end of the converter


def record(planned: Planned, folder: Path, spool: Path, report: Callable[[int], None]) -> Made:
    """Simulate the `planned` recording and write its files into `folder`, which must exist.

    The mean images go to the file `spool` first: the non-linearity is stated at the peak of the mean image,
    which is known only at the end. Memory does not grow with the number of frames, whose number so far
    `report` is called after every frame.
    """
    scene, mean_image_e = planned.scene, np.zeros(planned.scene.window)
    telescope = telescope_of(scene)

    def exposed() -> Iterator[tuple[np.ndarray, Mapping[int, float]]]:
        with open(spool, "wb") as stream:
            for index, exposure in enumerate(exposures(scene)):
                stream.write(exposure.mean_e.astype(np.float32).tobytes())
                mean_image_e[:] += exposure.mean_e / scene.frames
                introduced_nm = scene.introduced_per_frame_nm[index] * telescope.mode(DEFOCUS)
                yield exposure.opd_nm + introduced_nm, exposure.stated_nm
                report(index + 1)

    wavefronts = Wavefronts.of(telescope, exposed())
    rng = np.random.default_rng([*scene.seed, DETECTOR_STREAM])
    readout = Readout.of(scene, mean_image_e)
    brightest, saturated = 0, 0

    def frames() -> Iterator[np.ndarray]:
        nonlocal brightest, saturated
        with open(spool, "rb") as stream:
            while (mean_e := np.fromfile(stream, np.float32, mean_image_e.size)).size:
                frame = readout.frames_adu(mean_e.reshape(scene.window), rng)
                brightest = max(brightest, int(frame.max()))
                saturated += int((frame >= readout.top_adu).sum())
                yield frame

    write_files(planned, folder, readout, frames(), rng)
    spool.unlink()
    return Made(truth_content(planned, wavefronts), _wavefront_fits(wavefronts), brightest, saturated)


def truth_content(planned: Planned, wavefronts: Wavefronts) -> dict[str, Any]:
    """Return the content of the truth file of a `planned` recording with its `wavefronts`.

    ``ncpa_nm`` are the static modes that the scene states, with those of its effects and the error of the
    diversity; ``mean_zernike_nm`` is what an estimate is compared with: the time-averaged wavefront,
    introduced defocus included as the stage reached it, diversity excluded.
    """
    scene = planned.scene
    return {
        "hidden": planned.hidden,
        "ncpa_nm": dict(sorted(static_zernike_nm(scene).items())),
        "introduced_defocus_nm": planned.commanded_nm,
        "reached_defocus_nm": scene.introduced_nm,
        "mean_zernike_nm": wavefronts.mean_zernike_nm(),
        "photons_per_frame": scene.photons,
        "residual_wfe_nm": scene.residual_wfe_nm,
        "simulation": made_from(planned),
    }


def made_from(planned: Planned) -> dict[str, Any]:
    """Return all that a `planned` recording depends on, in JSON types."""
    made = jsonable({"version": VERSION, "recording": planned})
    if not planned.instrument:  # as before side-cars stated it
        del made["recording"]["instrument"]
    return made


def _wavefront_fits(wavefronts: Wavefronts) -> bytes:
    """FITS file: mean OPD (NaN outside the pupil), transmission, coefficients per frame."""
    telescope = wavefronts.telescope
    opd_nm = np.where(telescope.transmission > 0, wavefronts.mean_opd_nm, np.nan)
    opd = fits.PrimaryHDU(opd_nm.astype(np.float32))
    opd.header["BUNIT"] = ("nm", "mean OPD without the diversity")
    opd.header["STEP"] = (telescope.step_m, "[m] between samples; the axis is at the centre")
    pupil = fits.ImageHDU(telescope.transmission.astype(np.float32), name="TRANSMISSION")
    modes = fits.ImageHDU(wavefronts.zernike_nm, name="ZERNIKE")
    modes.header["BUNIT"] = ("nm", "RMS; frames x Noll 2..31")
    stream = BytesIO()
    fits.HDUList([opd, pupil, modes]).writeto(stream)
    return stream.getvalue()


@dataclass(frozen=True)
class Job:
    """One recording in the work folder; `count` jobs report their progress in one shared file."""

    planned: Planned
    work: Path
    index: int
    count: int

    @property
    def folder(self) -> Path:
        return self.work / "data" / self.planned.name

    def frames_done(self) -> np.ndarray:
        """Return the frames that each job has exposed, (count,); shared between processes."""
        path = self.work / "frames_done"
        return np.memmap(path, np.int64, "r+" if path.exists() else "w+", shape=self.count)

    def perform(self, report: Callable[[], Any] = lambda: None) -> Made:
        frames_done = self.frames_done()

        def show(frames: int) -> None:
            frames_done[self.index] = frames
            report()

        self.folder.mkdir(parents=True)
        return record(self.planned, self.folder, self.work / f"{self.index}.mean_e", show)


def make_all(
    planned: Sequence[Planned], parent: Path, jobs: int, progress: Callable[..., Any] | None
) -> Generator[tuple[Job, Made], None, None]:
    """Make recordings in a hidden folder below `parent`, on the same disk; yield them as they are finished.

    There are `jobs` worker processes; `progress` makes a progress bar that counts frames, see `simulate`.
    """
    if not planned:
        return
    total = sum(one.scene.frames for one in planned)
    bar = progress(total=total, desc="frames") if progress else tqdm(total=total, disable=True)
    folder = tempfile.TemporaryDirectory(prefix=WORK_PREFIX, dir=parent, ignore_cleanup_errors=True)
    with folder as work, bar as shown:
        tasks = [Job(one, Path(work), index, len(planned)) for index, one in enumerate(planned)]
        frames_done = tasks[0].frames_done()

        def show() -> None:
            shown.update(int(frames_done.sum()) - shown.n)

        if min(jobs, len(tasks)) > 1:
            yield from _side_by_side(tasks, jobs, show)
            return
        for task in tasks:  # here, with one thread as worker processes have: more give other last bits
            with threadpool_limits(1):
                made = task.perform(show)
            yield task, made


def _side_by_side(tasks: Sequence[Job], jobs: int, show: Callable[[], None]) -> Iterator[tuple[Job, Made]]:
    longest_first = sorted(tasks, key=lambda task: -task.planned.scene.frames * task.planned.scene.exposure_s)
    with in_processes(min(jobs, len(tasks)), Job.perform, [(task,) for task in longest_first]) as futures:
        owners: dict[Future, Job] = dict(zip(futures, longest_first, strict=True))
        while owners:
            done, _ = wait(owners, timeout=LOOK_S, return_when="FIRST_COMPLETED")
            show()
            yield from ((owners.pop(future), future.result()) for future in done)


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
    needed_bytes = sum(step.planned.size_bytes for step in steps if step.reason)
    above = target.path.absolute()
    free_bytes = shutil.disk_usage(next(path for path in (above, *above.parents) if path.exists())).free
    if needed_bytes > free_bytes:  # refused before hours of work
        raise ConfigurationError(
            f"--output {folder}: the recordings take {needed_bytes / 1e9:.1f} GB, {free_bytes / 1e9:.1f} are "
            "free; simulate fewer frames or a smaller window"
        )
    return steps


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
                name, scene = job.planned.name, job.planned.scene
                LOG.info("%s: %d frames, brightest pixel %d ADU", name, scene.frames, made.brightest_adu)
                values = scene.frames * int(np.prod(scene.window))
                if made.saturated > SATURATION_NOTED * values:
                    LOG.warning("%s: %d of %d values are saturated", name, made.saturated, values)
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
