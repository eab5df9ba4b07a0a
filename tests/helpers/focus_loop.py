"""A calibration made in memory, images for it, and a telescope that follows the loop's command."""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch

from helpers import optics_cases as cases
from irlos_pipe.control.exposures import Accumulator, Exposure, Read
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.focus import Focus, Limits
from irlos_pipe.estimate.lift import FrameErrors
from irlos_pipe.focus.calibration import Calibration, SharedErrors
from irlos_pipe.focus.journal import Record
from irlos_pipe.focus.service import FocusLoop, LoopSettings, Service
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.frames.recording import Acquisition, Detector
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.psf import PsfModel

WINDOW = (32, 32)
SETTINGS = cases.settings(WINDOW, ((1625.0, 1.0),), {6: -170.0}).for_single_frames()
NOISE = NoiseModel(1.0, 1.0)
ERRORS = SharedErrors(FrameErrors(3.0, 2.0, 1.0), np.array([-1000.0, 1000.0]), np.array([3.0, 5.0]))
FLUX_E = 2e5
MADE_UNIX_S = 1_700_000_000.0


@cache
def model() -> ImageModel:
    return ImageModel(PsfModel(SETTINGS, (2, 3, 4)))


@cache
def calibration(name: str = "first", instrument: str = "irlos") -> Calibration:
    sensor = Focus(model(), np.ones(WINDOW, bool), NOISE, Limits())
    detector = Detector(1.0, 1.0)
    acquisition = Acquisition("psf", detector, ((1625.0, 1.0),), {6: -170.0}, 9.7)
    return Calibration(sensor, name, load_instrument("irlos"), instrument, acquisition, MADE_UNIX_S, ERRORS)


def image_e(defocus_nm: float, seed: int, reads: int = 1, flux_e: float = FLUX_E) -> np.ndarray:
    x = torch.tensor([[5.0, -5.0, defocus_nm]], dtype=torch.float64)
    mean_e = model().psf.images(x)[0].double().clamp_min(0).numpy() * flux_e / reads
    rng = np.random.default_rng([seed, 7])
    return (rng.poisson(mean_e) + rng.normal(0, 1, WINDOW)).astype(np.float32)


def read(counter: int, defocus_nm: float, **changes) -> Read:
    image = changes.pop("image_e", None)
    image = image_e(defocus_nm, counter, **changes) if image is None else image
    return Read(counter, MADE_UNIX_S + counter, image)


@dataclass(frozen=True)
class Ready:
    """A request whose calibration is there already."""

    run: Path
    found: Calibration

    def load(self) -> Calibration:
        return self.found


@dataclass
class Listed:
    """A source of what was arranged, poll after poll; None when it is empty, or what `then` raises."""

    arrivals: list
    window: tuple[int, int] = WINDOW
    then: type[BaseException] | None = None

    def poll(self, timeout_s):
        if not self.arrivals and self.then is not None:
            raise self.then
        return self.arrivals.pop(0) if self.arrivals else None

    def close(self):
        pass


def served(
    output: Path, source, settings: LoopSettings, found: Calibration | None = None, **changes
) -> list[str]:
    """Let a loop run on a source to its end; return what it says."""
    said: list[str] = []
    request = Ready(output / "none", found or calibration())
    Service(output, request, settings, lambda *_: source, **changes).run(said.append)
    return said


def lines(output: Path) -> tuple[list[dict], list[str]]:
    content = [json.loads(line) for line in (output / "focus.jsonl").read_text().splitlines()]
    return [one for one in content if "sequence" in one], [one["event"] for one in content if "event" in one]


def exposure(index: int, defocus_nm: float = 0.0, **changes) -> Exposure:
    (one,) = Accumulator(1).add(read(index, defocus_nm, **changes))
    return one


def records(count: int, defocus_nm: float = 20.0) -> list[Record]:
    loop = FocusLoop(calibration(), LoopSettings())
    return [loop.record(exposure(index, defocus_nm), 0.0) for index in range(count)]
