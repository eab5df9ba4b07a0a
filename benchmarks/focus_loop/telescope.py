"""A simulated telescope for the focus loop: reads with sky, NCPAs and noise, and a focus that follows it.

The light comes from the simulator, which shares no optics with the model of the loop. Some seconds of sky are
tabulated over the defocus and drawn from in random order, so that an hour takes minutes.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.focus_loop.ageing import Ageing
from irlos_pipe.control.exposures import Read
from irlos_pipe.control.linear_theory import Drift, SodiumLayer
from irlos_pipe.files.atomic import atomic_file
from irlos_pipe.paper.common.focus_loop import FrameTable, frame_table
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.readout import electrons
from irlos_pipe.simulate.recordings.spec import load_spec
from irlos_pipe.simulate.scene import Sampling, Scene

REACH_NM, NODES = 1100.0, 44  # defocus of the tables: beyond the largest of a bootstrap
CLOSED_REACH_NM, CLOSED_NODES = 400.0, 18  # the same for a loop that has long been closed
SKY_READS, BURST_READS = 24, 8  # reads in the tables
DRIFT_STEPS = 10  # steps of the drift per exposure
START_UNIX_S = 1_707_620_000.0
FIRST_COUNTER = 400_000
LAYER = SodiumLayer(1.95, 23.0, 89.4e3)
SKY_STREAM, NOISE_STREAM, DRIFT_STREAM = range(3)


@dataclass(frozen=True)
class Night:
    """What the telescope does."""

    # spec, section: specification of a simulation and the recording in it that the frames are like.
    spec: str = "on_sky"
    section: str = "ramp"
    mag_j: float = 12.0
    # exposures, reads: exposures of a second, and reads of each.
    exposures: int = 120
    reads: int = 4
    delay: int = 1  # whole exposures from the end of one to the offset that follows from it
    start_nm: float = 700.0  # defocus before the loop is closed
    seed: int = 1
    burst_arcsec: float = 1.3  # seeing of a burst
    # Exposures with each fault, see `faults`.
    faults: dict[str, list[tuple[int, int]]] = field(default_factory=dict)
    ageing: Ageing = field(default_factory=Ageing)  # how NCPAs change; an exposure is a second

    def has(self, fault: str, exposure: int) -> bool:
        """Return whether an `exposure` has a `fault`."""
        return any(first <= exposure <= last for first, last in self.faults.get(fault, []))

    @property
    def drift(self) -> Drift:
        """Of the defocus, from the sodium layer."""
        return LAYER.drift(8.0)


class Exposed(NamedTuple):
    """One exposure: its `reads`, and the truth, the defocus of `drift_nm` and of the whole `residual_nm`."""

    reads: list[Read]
    drift_nm: float
    residual_nm: float


class Telescope:
    """Exposes one after the other; the `folder` keeps the tables for the next start."""

    def __init__(self, night: Night, folder: Path):
        self.night = night
        scene = scene_of(night)
        calm = kept_table(folder / "calm.npz", lambda: scene, REACH_NM, NODES)
        self._calm = [calm, *_later_tables(night, scene, folder)]
        self._scene, self._burst = scene, None
        if night.faults.get("burst"):
            stormy = replace(scene, frames=BURST_READS, sky=Sky(night.burst_arcsec))
            self._burst = kept_table(folder / "burst.npz", lambda: stormy, REACH_NM, NODES)
        rng = np.random.default_rng([night.seed, DRIFT_STREAM])
        steps_nm = night.drift.draw_nm(rng, night.exposures * DRIFT_STEPS, 1 / DRIFT_STEPS)
        self._drift_nm = night.start_nm + steps_nm.reshape(night.exposures, DRIFT_STEPS)
        self.queue_nm = deque([0.0] * (night.delay + 1), maxlen=night.delay + 1)

    def expose(self, index: int) -> Exposed:
        """Expose number `index`, with the offset that has arrived by now."""
        night, drift_nm = self.night, float(self._drift_nm[index].mean())
        residual_nm = drift_nm - self.queue_nm[0]
        rng = np.random.default_rng([night.seed, NOISE_STREAM, index])
        calm = self._calm[min(int(index // night.ageing.step_s), len(self._calm) - 1)]
        table = self._burst if self._burst is not None and night.has("burst", index) else calm
        flux = 0.0 if night.has("lost", index) else 1.0
        reads = [self._read(index, one, table, flux, residual_nm, rng) for one in range(night.reads)]
        return Exposed(reads, drift_nm, residual_nm)

    def _read(self, index: int, one: int, table: FrameTable, flux: float, residual_nm: float, rng) -> Read:
        frame = int(rng.integers(table.series_e.shape[1]))
        bounded = np.clip([residual_nm], -table.reach_nm, table.reach_nm)
        mean_e = flux * np.maximum(table.images_e(frame, bounded), 0.0)
        image_e = electrons(self._scene, mean_e, rng)[0]
        number = index * self.night.reads + one
        clock_s = 3600.0 if self.night.has("clock", index) else 0.0
        return Read(FIRST_COUNTER + number, START_UNIX_S + clock_s + number / self.night.reads, image_e)


def _later_tables(night: Night, scene: Scene, folder: Path) -> list[FrameTable]:
    """Reads with the NCPAs of the middle of every later step; none where nothing changes."""
    if night.ageing.none:
        return []
    step_s = night.ageing.step_s
    return [
        kept_table(
            folder / f"calm_{step}.npz",
            lambda step=step: night.ageing.aged(scene, (step + 0.5) * step_s / 3600, night.seed),
            CLOSED_REACH_NM,
            CLOSED_NODES,
        )
        for step in range(1, math.ceil(night.exposures / step_s))
    ]


def kept_table(kept: Path, scene: Callable[[], Scene], reach_nm: float, nodes: int) -> FrameTable:
    """Return the reads of a scene at any defocus; they take a while to simulate, and are `kept` in a file."""
    if not kept.exists():
        table = frame_table(scene(), reach_nm, nodes)
        with atomic_file(kept) as stream:
            np.savez(stream, series_e=table.series_e, sky_focus_nm=table.sky_focus_nm)
    with np.load(kept) as found:
        return FrameTable(reach_nm, found["series_e"], found["sky_focus_nm"])


def scene_of(night: Night) -> Scene:
    """Return the reads of the recording of the specification, of another star."""
    return replace(
        load_spec(night.spec).scenes[night.section],
        seed=(night.seed, SKY_STREAM),
        frames=SKY_READS,
        exposure_s=1 / night.reads,
        frame_rate_hz=float(night.reads),
        mag_j=night.mag_j,
        introduced_nm=0.0,
        sampling=Sampling(points_per_band=2, step_s=0.05),
    )
