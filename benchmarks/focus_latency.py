"""How long one measurement of the focus takes: `Focus.solved` and LIFT of one frame, on the same images.

Calls alternate in blocks, so that both meet the same load of the machine. Processor time is what a quiet core
would show; the wall clock has other programs in it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import click
import numpy as np
import torch
from threadpoolctl import threadpool_limits

from benchmarks.cases import TWO_WAVELENGTHS
from benchmarks.inputs import DIVERSITY_NM, PIXEL_SCALE_MAS, WINDOW_PX
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.focus import Focus
from irlos_pipe.estimate.lift import lift
from irlos_pipe.estimate.tabulated import tabulated
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings

WINDOW = (WINDOW_PX, WINDOW_PX)
NOISE = NoiseModel(1.0, 1.0)
FLUX_E, SPREAD_NM, IMAGES = 1e5, 100.0, 256
BLOCK, LIFT_SHARE = 500, 10  # calls of the sensor and of LIFT, which take turns
EDGES_MS = (0.0, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0, np.inf)


@dataclass(frozen=True)
class Times:
    """Wall clock and processor time of every call, (calls,) each [ms]."""

    wall_ms: np.ndarray
    cpu_ms: np.ndarray

    @classmethod
    def joined(cls, parts: list[Times]) -> Times:
        """Join several blocks of calls."""
        return cls(*(np.concatenate([getattr(one, name) for one in parts]) for name in ("wall_ms", "cpu_ms")))

    def line(self, name: str) -> str:
        """Percentiles as a line of a table."""
        numbers = [
            np.percentile(times, percent) for times in (self.wall_ms, self.cpu_ms) for percent in (50, 99)
        ]
        return f"{name:<24}{len(self.wall_ms):>8}" + "".join(f"{number:>10.2f}" for number in numbers)


@click.command()
@click.option("--calls", default=100_000, show_default=True, help="Calls of the sensor.")
def main(calls: int) -> None:
    """Print percentiles of both, and a histogram of the sensor's processor time."""
    torch.set_num_threads(1)
    with threadpool_limits(1), torch.inference_mode():
        focus, single = compare(calls)
    print(f"{'':<24}{'calls':>8}{'wall p50':>10}{'p99':>10}{'CPU p50':>10}{'p99':>10}   [ms]")
    print(single.line("lift, one frame"), focus.line("Focus.solved"), *histogram(focus.cpu_ms), sep="\n")


def compare(calls: int) -> tuple[Times, Times]:
    """Time `calls` of the sensor and a fiftieth as many of LIFT."""
    model, images_e = prepared()
    good = np.ones(WINDOW, bool)
    sensor = Focus(model, good, NOISE)
    start_nm = torch.zeros(1, 3, dtype=torch.float64)
    table = tabulated(model, start_nm)

    def fit(image_e: np.ndarray) -> None:
        lift(table, torch.from_numpy(image_e)[None], torch.from_numpy(good), NOISE, start_nm)

    blocks = [
        (timed(sensor.solved, images_e, min(BLOCK, calls)), timed(fit, images_e, LIFT_SHARE))
        for _ in range(max(1, calls // BLOCK))
    ]
    ours, theirs = zip(*blocks, strict=True)
    return Times.joined(list(ours)), Times.joined(list(theirs))


def prepared() -> tuple[ImageModel, np.ndarray]:
    """The model of two wavelengths, and images with noise."""
    pupil = load_instrument("irlos").pupil
    settings = PsfSettings(pupil, WINDOW, PIXEL_SCALE_MAS, TWO_WAVELENGTHS, KnownWavefront(DIVERSITY_NM))
    model = ImageModel(PsfModel(settings.for_single_frames(), (2, 3, 4)))
    rng = np.random.default_rng(1)
    truth_nm = torch.as_tensor(rng.uniform(-SPREAD_NM, SPREAD_NM, (IMAGES, 3)))
    mean_e = model.psf.images(truth_nm).double().clamp_min(0).numpy() * FLUX_E
    return model, rng.poisson(mean_e) + rng.normal(0, 1, mean_e.shape)


def timed(call: Callable[[np.ndarray], object], images_e: np.ndarray, calls: int) -> Times:
    """Time so many `calls`, one image after the other."""
    call(images_e[0])
    wall_s, cpu_s = np.empty((2, calls))
    for index in range(calls):
        image = images_e[index % len(images_e)]
        wall, cpu = time.perf_counter(), time.thread_time()
        call(image)
        wall_s[index], cpu_s[index] = time.perf_counter() - wall, time.thread_time() - cpu
    return Times(wall_s * 1e3, cpu_s * 1e3)


def histogram(times_ms: np.ndarray) -> Iterator[str]:
    """Yield a line per bin of `times_ms` that has calls."""
    counts, _ = np.histogram(times_ms, EDGES_MS)
    for low, high, count in zip(EDGES_MS, EDGES_MS[1:], counts, strict=False):
        if count:
            yield f"{low:6.2f} to {high:5.2f} ms{count:>9}  {'#' * round(60 * count / len(times_ms))}"


if __name__ == "__main__":
    main()
