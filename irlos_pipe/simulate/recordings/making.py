"""Makes recordings and their truth in a hidden folder, in one process or several; each appears when complete.

The truth is what an estimate is compared with; it is stored separately from the data.
"""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from irlos_pipe.conventions.modes import DEFOCUS
from irlos_pipe.files.json import jsonable
from irlos_pipe.files.processes import in_processes
from irlos_pipe.simulate.exposure import Wavefronts, exposures, static_zernike_nm, telescope_of
from irlos_pipe.simulate.readout import Readout
from irlos_pipe.simulate.recordings.files import Planned, write_files

LOG = logging.getLogger("irlos_pipe.run")
VERSION = 2  # of the simulator; raised when the same spec and seed give other data or another truth
DETECTOR_STREAM = 1  # child of the scene's seed; the wavefront has its own
WORK_PREFIX = ".simulating-"
LOOK_S = 0.3  # interval at which the progress of the worker processes is read


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
    scene = planned.scene
    wavefronts, mean_image_e = Wavefronts(telescope_of(scene)), np.zeros(scene.window)
    defocus = wavefronts.telescope.mode(DEFOCUS)
    with open(spool, "wb") as stream:
        for index, exposure in enumerate(exposures(scene)):
            stream.write(exposure.mean_e.astype(np.float32).tobytes())
            mean_image_e += exposure.mean_e / scene.frames
            introduced_nm = scene.introduced_per_frame_nm[index]
            wavefronts.add(exposure.opd_nm + introduced_nm * defocus, exposure.stated_nm)
            report(index + 1)
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
    return jsonable({"version": VERSION, "recording": planned})


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
    with _work_folder(parent) as work, bar as shown:
        tasks = [Job(one, work, index, len(planned)) for index, one in enumerate(planned)]
        frames_done = tasks[0].frames_done()

        def show() -> None:
            shown.update(int(frames_done.sum()) - shown.n)

        yield from _in_turn(tasks, show) if min(jobs, len(tasks)) == 1 else _side_by_side(tasks, jobs, show)


def _in_turn(tasks: Sequence[Job], show: Callable[[], None]) -> Iterator[tuple[Job, Made]]:
    """Perform the tasks here, with one thread as worker processes have: more give other last bits."""
    for task in tasks:
        with threadpool_limits(1):
            made = task.perform(show)
        yield task, made


def _side_by_side(tasks: Sequence[Job], jobs: int, show: Callable[[], None]) -> Iterator[tuple[Job, Made]]:
    """Perform the tasks in worker processes."""
    longest_first = sorted(tasks, key=lambda task: -task.planned.scene.frames * task.planned.scene.exposure_s)
    with in_processes(min(jobs, len(tasks)), Job.perform, [(task,) for task in longest_first]) as futures:
        owners: dict[Future, Job] = dict(zip(futures, longest_first, strict=True))
        while owners:
            done, _ = wait(owners, timeout=LOOK_S, return_when="FIRST_COMPLETED")
            show()
            yield from ((owners.pop(future), future.result()) for future in done)


@contextmanager
def _work_folder(parent: Path) -> Iterator[Path]:
    """A hidden folder, gone at the end."""
    work = Path(tempfile.mkdtemp(prefix=WORK_PREFIX, dir=parent))
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
