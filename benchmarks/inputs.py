"""What the timed cases work on, prepared once and read by the process of every case; and their stopwatch.

Monochromatic calibration frames with known truth are drawn by the simulator of ``data_samples``, which shares
no code with any of the implementations that are timed.
"""

from __future__ import annotations

import json
import logging
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from irlos_pipe.estimate.calibration_options import NcpaPrior
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.pipeline.resources import silent_progress
from irlos_pipe.product.storage import read_product
from irlos_pipe.stages.base import ModelConfig, StageContext
from irlos_pipe.stages.calibrate.stage import Config as CalibrateConfig
from irlos_pipe.stages.lift import stage as lift

SAMPLES = Path(__file__).parents[1] / "data_samples"
RECIPES = SAMPLES.parent / "recipes"
WAVELENGTH_NM = 1600.0
WINDOW_PX, PIXEL_SCALE_MAS = 64, 9.7
READ_NOISE_E = 1.0
SUBEXPOSURES = 5  # samples of the AO residual and the image motion within a frame
NOLLS = tuple(range(2, 31))
DIVERSITY_NM = {6: -170.0}
SEED = 17


@dataclass(frozen=True)
class BenchFrames:
    """Frames and what an estimate is compared with."""

    images_e: np.ndarray  # (frames, rows, columns), float32: photo-electrons, background subtracted
    # (frames, modes), nm RMS: least-squares `NOLLS` of the wavefront averaged over each frame.
    truth_nm: np.ndarray

    def error_nm(self, estimates_nm: np.ndarray) -> float:
        """Total RMS over the modes of the mean estimate of the first frames against their mean truth."""
        truth_nm = self.truth_nm[np.arange(len(estimates_nm)) % len(self.truth_nm)]
        difference = np.nanmean(estimates_nm, axis=0) - truth_nm.mean(axis=0)
        return float(np.sqrt(np.sum(difference**2)))


def draw(count: int, progress=iter) -> BenchFrames:
    """Draw frames of 0.1 s under the conditions of ``data_samples/calibration-sky``, at one wavelength.

    `progress` wraps the iterable of frame numbers, for a progress bar.
    """
    simulator = _Simulator(count)
    drawn = [simulator.frame() for _ in progress(range(count))]
    return BenchFrames(*(np.stack(part) for part in zip(*drawn, strict=True)))


class _Simulator:
    """One sequence of frames."""

    def __init__(self, count: int):
        if str(SAMPLES) not in sys.path:
            sys.path.insert(0, str(SAMPLES))
        from simulator import atmosphere, campaign, imaging, telescope

        scene, step_s = campaign.CALIBRATION, campaign.CALIBRATION.exposure_s / SUBEXPOSURES
        self.rng = np.random.default_rng(SEED)
        self.flux_e = scene.photons
        self.telescope = telescope.build_telescope()
        self.imager = imaging.Imager(self.telescope, [WAVELENGTH_NM], [1.0], WINDOW_PX, PIXEL_SCALE_MAS)
        self.screens = atmosphere.ResidualScreens(self.telescope, scene.seeing_arcsec, step_s, self.rng)
        motion_mas = atmosphere.jitter_mas(scene.jitter_mas, step_s, count * SUBEXPOSURES, self.rng)
        self.tilts_nm = iter([[telescope.tilt_nm(angle) for angle in pair] for pair in motion_mas])
        self.static_nm = self.telescope.opd_nm(scene.ncpa_nm)
        self.stated_nm = np.array([scene.ncpa_nm.get(noll, 0.0) for noll in NOLLS])
        self.diversity_nm = self.telescope.opd_nm(DIVERSITY_NM)

    def frame(self) -> tuple[np.ndarray, np.ndarray]:
        """Image [e-] and true coefficients [nm] of the next frame."""
        opds_nm = [self._next_opd_nm() for _ in range(SUBEXPOSURES)]
        clean = np.mean([self.imager.image(opd + self.diversity_nm) for opd in opds_nm], axis=0) * self.flux_e
        noisy = self.rng.poisson(clean) + self.rng.normal(0.0, READ_NOISE_E, clean.shape)
        return noisy.astype(np.float32), self._true_nm(np.mean(opds_nm, axis=0))

    def _next_opd_nm(self) -> np.ndarray:
        tilt_nm = np.tensordot(next(self.tilts_nm), self.telescope.modes[1:3], axes=1)
        return self.static_nm + self.screens.next_nm() + tilt_nm

    def _true_nm(self, opd_nm: np.ndarray) -> np.ndarray:
        """What `Telescope.fit_zernike_nm` of the simulator returns, with the normal matrix kept."""
        if not hasattr(self, "_normal"):
            modes = self.telescope.modes[: NOLLS[-1] + 1].reshape(NOLLS[-1] + 1, -1)
            self._weighted = modes * self.telescope.transmission.ravel()
            self._normal = self._weighted @ modes.T
        rest_nm = (opd_nm - self.static_nm).ravel()
        return self.stated_nm + np.linalg.solve(self._normal, self._weighted @ rest_nm)[1 : NOLLS[-1]]


def reduction(output: Path) -> list[str]:
    """Return the command that reduces the data samples as far as LIFT needs them."""
    told = [
        "run",
        str(RECIPES / "full_reduction.yaml"),
        "--samples",
        "--output",
        str(output),
        "--to",
        "calibrate",
        "-q",
    ]
    return [sys.executable, "-m", "irlos_pipe", *told]


def prepare(folder: Path, frames: int, progress) -> None:
    """Draw the frames, and reduce the data samples as far as LIFT needs them."""
    drawn = draw(frames, progress)
    np.savez(folder / "frames.npz", images_e=drawn.images_e, truth_nm=drawn.truth_nm)
    command = reduction(folder / "run")
    subprocess.run(command, check=False, capture_output=True)
    if not list((folder / "run").glob("*_calibrate.h5")):
        raise SystemExit(f"the reduction of the data samples failed; repeat it with: {' '.join(command[1:])}")


@dataclass(frozen=True)
class Inputs:
    """Prepared inputs of the cases."""

    folder: Path  # where `prepare` left them
    device: str = "cpu"  # where this project's code computes

    @cached_property
    def frames(self) -> BenchFrames:
        """The drawn monochromatic frames with their truth."""
        stored = np.load(self.folder / "frames.npz")
        return BenchFrames(stored["images_e"], stored["truth_nm"])

    @cached_property
    def settings(self) -> PsfSettings:
        """PSF model of the drawn frames."""
        return PsfSettings(
            load_instrument("irlos").pupil,
            (WINDOW_PX, WINDOW_PX),
            PIXEL_SCALE_MAS,
            ((WAVELENGTH_NM, 1.0),),
            KnownWavefront(DIVERSITY_NM),
        )

    @property
    def prior(self) -> NcpaPrior | None:
        """Prior that the stage `calibrate` gives the modes."""
        return CalibrateConfig().options(load_instrument("irlos").facility.ncpa_law).prior

    def calibration_frames(self, count: int) -> Frames:
        """The first drawn frames as `calibrate` takes them, over and over if these are not enough."""
        drawn_e = self.frames.images_e
        return Frames(
            torch.as_tensor(drawn_e[np.arange(count) % len(drawn_e)]),
            torch.ones(WINDOW_PX, WINDOW_PX, dtype=torch.bool),
            NoiseModel(1.0, READ_NOISE_E**2),
        )

    @cached_property
    def context(self) -> StageContext:
        """Context of the stage `lift` behind the reduction of the data samples."""
        products = [read_product(path) for path in sorted((self.folder / "run").glob("*.h5"))]
        return StageContext(
            lift.Config(),
            ModelConfig(),
            load_instrument("irlos"),
            {},
            {product.stage: product for product in products},
            self.device,
            0,
            1,
            silent_progress,
            logging.getLogger("benchmarks"),
            self.folder / "scratch",
        )


def true_zernike_nm(sample: str) -> dict[int, float]:
    """Mean wavefront of a data sample (Noll: nm RMS), by its name in ``data_samples/truth``."""
    known = json.loads((SAMPLES / "truth" / f"{sample}.json").read_text())
    return {int(noll): value for noll, value in known["mean_zernike_nm"].items()}


# -- time and memory ---------------------------------------------------------------------------


@dataclass
class Stopwatch:
    """Wall-clock and processor time of a block [s], that of all threads and of the one that calls them."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    caller_s: float = 0.0

    def over(self, frames: int) -> dict:
        """Part of a case's outcome: the times, and the number of frames they were taken over."""
        return {"frames": frames} | vars(self)


@contextmanager
def stopwatch() -> Iterator[Stopwatch]:
    """Time a block; the yielded `Stopwatch` is set when the block ends."""
    watch = Stopwatch()
    clocks = time.perf_counter, processor_time, time.thread_time
    began = [clock() for clock in clocks]
    yield watch
    watch.wall_s, watch.cpu_s, watch.caller_s = (
        clock() - start for clock, start in zip(clocks, began, strict=True)
    )


def processor_time() -> float:
    """Return the processor time [s] of this process and of those that it began and that have ended."""
    of_children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + of_children.ru_utime + of_children.ru_stime


def peak_mib() -> float:
    """Largest resident size of this process so far [MiB]."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20
