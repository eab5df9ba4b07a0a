"""What the cases work on, prepared once and read by the process of every case."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from benchmarks.frames import (
    DIVERSITY_NM,
    PIXEL_SCALE_MAS,
    READ_NOISE_E,
    SAMPLES,
    WAVELENGTH_NM,
    WINDOW_PX,
    BenchFrames,
    draw,
)
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.ncpa_prior import NcpaPrior
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings
from irlos_pipe.product.product import Product
from irlos_pipe.product.storage import read_product
from irlos_pipe.stages.base import StageContext
from irlos_pipe.stages.calibrate.stage import Config as CalibrateConfig
from irlos_pipe.stages.lift import stage as lift
from irlos_pipe.stages.model.section import ModelConfig

RECIPE = SAMPLES.parent / "recipes" / "full_reduction.yaml"


def reduction(output: Path) -> list[str]:
    """Return the command that reduces the data samples as far as LIFT needs them."""
    told = ["run", str(RECIPE), "--samples", "--output", str(output), "--to", "calibrate", "-q"]
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
    """Prepared inputs of the cases.

    Attributes
    ----------
    folder : Path
        Where `prepare` left them.
    device : str
        Where this project's code computes.
    """

    folder: Path
    device: str = "cpu"

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
        """The first drawn frames as `calibrate` takes them."""
        return Frames(
            torch.as_tensor(self.frames.images_e[:count]),
            torch.ones(WINDOW_PX, WINDOW_PX, dtype=torch.bool),
            NoiseModel(1.0, READ_NOISE_E**2),
        )

    @cached_property
    def context(self) -> StageContext:
        """Context of the stage `lift` behind the reduction of the data samples."""
        return StageContext(
            lift.Config(),
            ModelConfig(),
            load_instrument("irlos"),
            {},
            self._products,
            self.device,
            0,
            1,
            _silent,
            logging.getLogger("benchmarks"),
            self.folder / "scratch",
        )

    @property
    def _products(self) -> dict[str, Product]:
        read = [read_product(path) for path in sorted((self.folder / "run").glob("*.h5"))]
        return {product.stage: product for product in read}


def true_zernike_nm(sample: str) -> dict[int, float]:
    """Mean wavefront of a data sample (Noll: nm RMS), by its name in ``data_samples/truth``."""
    known = json.loads((SAMPLES / "truth" / f"{sample}.json").read_text())
    return {int(noll): value for noll, value in known["mean_zernike_nm"].items()}


def _silent(iterable=None, total=None, desc=""):
    return tqdm(iterable, total=total, desc=desc, disable=True)
