"""``python memory_case.py FRAMES``: how far memory rises in each step of reducing so many frames [bytes].

Linux only: free memory is given back, and the peak reset, before every step.
"""

import ctypes
import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from helpers import optics_cases as cases
from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.elongation import axis_ratios
from irlos_pipe.frames.bad_pixels import Thresholds
from irlos_pipe.frames.cleaning import clean
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.frames.recording import Detector, RawFrames
from irlos_pipe.frames.screening import Limits
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.stages.ingest.stage import Config

SETTINGS = cases.settings(64, pupil_samples=48)
HIGHEST_NOLL, PEDESTAL_ADU, FLUX_E, DRAWN = 4, 200.0, 1e6, 40
SAMPLING_PX = 4.2


def rise_bytes(step: Callable[[], object]) -> int:
    """Highest resident size during a step above that before it."""
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")
    before = _status("VmRSS")
    step()
    return _status("VmHWM") - before


def _status(key: str) -> int:
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(key))
    return int(line.split()[1]) * 1024


CONFIG = Config()


def recorded(frames: int) -> np.ndarray:
    nolls = range(2, HIGHEST_NOLL + 1)
    mean = PsfModel(SETTINGS, nolls).images(torch.zeros(1, len(nolls))).double().numpy() * FLUX_E
    some = cases.draw_frames(mean, DRAWN, seed=1).numpy() + PEDESTAL_ADU
    adu = np.empty((frames, *some.shape[1:]), np.uint16)
    rng = np.random.default_rng(2)
    for number in range(frames):
        adu[number] = np.rint(some[number % DRAWN] + rng.normal(0, 1, some.shape[1:])).clip(0)
    adu[:: frames // 20, 10, 12] += 5000
    adu[:, 40, 7] = 0
    return adu


def main(frames: int) -> dict[str, int]:
    """Rise of each step; libraries have been at work on a few frames before."""
    adu, kept = recorded(frames), {}

    def ingest(count: int) -> None:
        raw = RawFrames(adu=adu[:count], frame_counter=np.arange(count))
        limits = CONFIG.part(Thresholds), CONFIG.part(Limits)
        kept["images"] = clean(raw, Detector(1.0, 1.0), SAMPLING_PX, *limits).images_e

    def cube(count: int) -> Frames:
        images = torch.as_tensor(kept["images"][:count])
        return Frames(images, cases.everything(images), NoiseModel(1.0, 1.0))

    def prior(count: int) -> None:
        axis_ratios(cube(count).images_e, cube(count).good, 0.0)

    def calibration(method: str) -> Callable[[int], None]:
        options = CalibrationOptions(method, highest_noll=HIGHEST_NOLL, max_iterations=1, prior=cases.PRIOR)
        return lambda count: calibrate(cube(count), SETTINGS, options) and None

    methods = {method: calibration(method) for method in ("long_exposure", "dip_global")}
    rises = {}
    for name, step in {"ingest": ingest, "prior": prior, **methods}.items():
        step(DRAWN)
        rises[name] = rise_bytes(lambda step=step: step(frames))
    return rises


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps(main(int(sys.argv[1]))))
