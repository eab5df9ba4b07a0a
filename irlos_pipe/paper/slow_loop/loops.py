"""Loops closed side by side on the same sky and the same drift, each with its own star and controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from irlos_pipe.paper.common.observation import noise_of, recorded_e
from irlos_pipe.paper.slow_loop.frames import FrameTable
from irlos_pipe.paper.slow_loop.two_by_two import Sensor
from irlos_pipe.simulate.scene import Scene


@dataclass(frozen=True)
class Loop:
    """One loop.

    Attributes
    ----------
    sensor : str
        Name of its sensor.
    mag_j : float
        Of its star.
    gain : float
    exposures : int
        Frames of the sky that one image of the sensor collects.
    """

    sensor: str
    mag_j: float
    gain: float
    exposures: int = 1

    def brightness(self, mag_j: float) -> float:
        """Return the photons per second of its star over those of a star of magnitude `mag_j`."""
        return 10 ** (-0.4 * (self.mag_j - mag_j))


@dataclass(frozen=True)
class LoopRecord:
    """Residuals and measurements of every loop.

    Attributes
    ----------
    residual_nm : ndarray, (loops, frames)
        Mean of each frame of drift minus command; NaN after a loop has diverged.
    measured_nm : ndarray, (loops, frames)
        Measurements, at the last frame of their exposure; NaN where there is none.
    true_nm : ndarray, (loops, frames)
        The measurement of a perfect sensor: the mean residual of the exposure.
    due : ndarray of bool, (loops, frames)
        Where a measurement was due.
    """

    residual_nm: np.ndarray
    measured_nm: np.ndarray
    true_nm: np.ndarray
    due: np.ndarray


def close_loops(
    loops: Sequence[Loop],
    sensors: Mapping[str, Sensor],
    scenes: Mapping[int, Scene],
    table: FrameTable,
    drift_nm: np.ndarray,
    delay: int,
    rng: np.random.Generator,
) -> LoopRecord:
    """Run all loops over the same frames.

    Parameters
    ----------
    loops : sequence of Loop
    sensors : mapping of str to Sensor
        By the names that the loops use.
    scenes : mapping of int to Scene
        The sky in exposures of so many frames.
    table : FrameTable
        Its frames at any defocus.
    drift_nm : ndarray, (frames,)
        Mean defocus of the disturbance in every frame. What it wanders within one is too little to
        change the image other than through its mean.
    delay : int
        See `Integrator`, in exposures of the loop.
    rng : Generator
        Of the detector noise.
    """
    bank = _Bank(loops, len(drift_nm), delay, table)
    flux = np.array([loop.brightness(scenes[loop.exposures].mag_j) for loop in loops])[:, None, None]
    alike = dict.fromkeys((loop.sensor, loop.exposures) for loop in loops)
    for frame, drift in enumerate(drift_nm):
        bank.expose(frame, drift, flux)
        for name, exposures in alike:
            members = bank.ready(frame, name, exposures)
            if len(members):
                images_e = recorded_e(scenes[exposures], bank.images_e[members], rng)
                bank.correct(members, frame, sensors[name].measure(images_e, noise_of(scenes[exposures])))
    return bank.record()


class _Bank:
    """The loops while they run."""

    def __init__(self, loops: Sequence[Loop], frames: int, delay: int, table: FrameTable):
        self.sensor = np.array([loop.sensor for loop in loops])
        self.gain = np.array([loop.gain for loop in loops])
        self.exposures = np.array([loop.exposures for loop in loops])
        self.delay, self.table = delay, table
        self.command_nm = np.zeros((len(loops), frames))
        self.residual_nm, self.measured_nm, self.true_nm = np.full((3, len(loops), frames), np.nan)
        self.due = np.zeros((len(loops), frames), dtype=bool)
        self.alive = np.ones(len(loops), dtype=bool)
        self.images_e = np.zeros((len(loops), *table.series_e.shape[2:]))

    def expose(self, frame: int, drift_nm: float, flux: np.ndarray) -> None:
        """Add one frame to the image of every loop; the first of an exposure begins a new image."""
        residual = drift_nm - self.command_nm[:, frame]
        self.alive &= np.abs(residual) <= self.table.reach_nm
        self.residual_nm[:, frame] = np.where(self.alive, residual, np.nan)
        seen = np.where(self.alive, residual, 0.0)
        keep = (frame % self.exposures != 0)[:, None, None]
        self.images_e = keep * self.images_e + flux * self.table.images_e(frame, seen)

    def ready(self, frame: int, sensor: str, exposures: int) -> np.ndarray:
        """Return the loops of `sensor` with exposures of so many frames that end with `frame`."""
        if (frame + 1) % exposures:
            return np.array([], dtype=int)
        return np.flatnonzero(self.alive & (self.sensor == sensor) & (self.exposures == exposures))

    def correct(self, members: np.ndarray, frame: int, measured_nm: np.ndarray) -> None:
        """Record the measurements and change the commands; without a measurement a command is held."""
        for member, measured in zip(members, measured_nm, strict=True):
            exposures = self.exposures[member]
            effect = frame + 1 + self.delay * exposures
            self.due[member, frame] = True
            self.measured_nm[member, frame] = measured
            self.true_nm[member, frame] = self.residual_nm[member, frame + 1 - exposures : frame + 1].mean()
            if np.isfinite(measured):
                self.command_nm[member, effect:] += self.gain[member] * measured

    def record(self) -> LoopRecord:
        """Return residuals and measurements of all frames."""
        return LoopRecord(self.residual_nm, self.measured_nm, self.true_nm, self.due)
