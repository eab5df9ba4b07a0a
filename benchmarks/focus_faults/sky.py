"""Exposures of the simulated sky at any defocus, right ones and those of another scene.

The light comes from the simulator, which shares no optics with the model of the loop. Reads of a quarter of a
second are tabulated over the defocus once and drawn in random order, so that an hour takes seconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from benchmarks.focus_loop.telescope import Night, scene_of
from irlos_pipe.files.atomic import atomic_file
from irlos_pipe.paper.common.focus_loop import FrameTable, frame_table
from irlos_pipe.simulate.atmosphere import Sky
from irlos_pipe.simulate.scene import Scene

READS = 4  # of an exposure of a second
TABLED_MAG_J = 8.0
REACH_NM, NODES, TABLED_READS = 450.0, 20, 32
NEAR_NM, NEAR_NODES, NEAR_READS = 160.0, 10, 12  # of scenes with something wrong
SEEINGS = (0.3, 0.5, 0.8, 1.3)
USUAL_SEEING = 0.5  # of the calibration
_KEPT: dict[Path, FrameTable] = {}


@dataclass(frozen=True)
class Look:
    """What the telescope sees: `seeing` [arcsec], and `changes` of the scene, unknown to the loop."""

    seeing: float = USUAL_SEEING
    changes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Of the file of its table."""
        return f"seeing_{self.seeing}_{crc32(repr(sorted(self.changes.items())).encode()):08x}"


@dataclass(frozen=True)
class Skies:
    """Tables of looks in a `folder`, of the sky of a `seed`."""

    folder: Path
    seed: int

    def table(self, look: Look) -> FrameTable:
        """Return the reads of a `look`; they take a while to simulate."""
        path = self.folder / f"{self.seed}_{look.name}.npz"
        return _KEPT.get(path) or _KEPT.setdefault(path, _made(path, look, self.seed))

    def exposure_e(
        self, look: Look, mag_j: float, defocus_nm: float, rng: np.random.Generator, reads: int = READS
    ) -> tuple[np.ndarray, float]:
        """Return the mean electrons of one exposure, without noise, and its defocus with that of the sky."""
        table = self.table(look)
        frames = rng.integers(table.series_e.shape[1], size=reads)
        bounded = np.clip([defocus_nm], -table.reach_nm, table.reach_nm)
        mean_e = sum(table.images_e(frame, bounded)[0] for frame in frames)
        light = 10 ** (0.4 * (TABLED_MAG_J - mag_j))
        return np.maximum(mean_e, 0.0) * light, defocus_nm + float(table.sky_focus_nm[frames].mean())


def noisy_e(mean_e: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return what the detector makes of an exposure, (rows, columns) [e-], sky in it.

    Reads are drawn at once, their noises add, so that none of them is clipped by the converter.
    """
    scene = _detector()
    factor, read_e = scene.detector.excess_noise_factor, scene.detector.read_noise_e
    charge_e = rng.poisson(mean_e + (scene.sky_e_per_s + scene.detector.dark_e_per_s) * scene.exposure_s)
    spread_e = np.sqrt((factor - 1) * charge_e + scene.reads * read_e**2)
    return (charge_e - scene.detector.dark_e_per_s + spread_e * rng.standard_normal(mean_e.shape)).astype(
        np.float32
    )


@cache
def _detector() -> Scene:
    return scene_of(Night(reads=1))


def _scene(look: Look, seed: int) -> Scene:
    scene = scene_of(Night(mag_j=TABLED_MAG_J, reads=READS))
    reads = NEAR_READS if look.changes else TABLED_READS
    scene = replace(scene, frames=reads, seed=(seed, 5), sky=Sky(look.seeing))
    return replace(scene, **{key: _merged(getattr(scene, key), value) for key, value in look.changes.items()})


def _merged(old: Any, new: Any) -> Any:
    return {**old, **new} if isinstance(new, dict) else new


def _made(path: Path, look: Look, seed: int) -> FrameTable:
    reach, nodes = (NEAR_NM, NEAR_NODES) if look.changes else (REACH_NM, NODES)
    if not path.exists():
        table = frame_table(_scene(look, seed), reach, nodes)
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(path) as stream:
            np.savez(stream, series_e=table.series_e, sky_focus_nm=table.sky_focus_nm)
    with np.load(path) as found:
        return FrameTable(reach, found["series_e"], found["sky_focus_nm"])
