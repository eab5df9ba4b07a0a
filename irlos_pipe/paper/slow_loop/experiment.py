"""The slow focus loop closed on LIFT: what the wandering sodium layer leaves, against the star's magnitude.

One sample is one sky with its own NCPAs, calibrated on a narrow-band cube as an observer would, and a
few drifts. All loops of a sample (configurations, stars, gains) run on the same sky and drifts. The NCPAs
have no tip, tilt and defocus: a loop drives those to zero by itself, and its own zero is what counts here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from irlos_pipe.control.disturbance import Drift
from irlos_pipe.control.linear_theory import best_gain
from irlos_pipe.conventions.facility import Facility
from irlos_pipe.paper.common.broad_band import FINE, star_scene
from irlos_pipe.paper.common.cube import BRIGHT_MAG_J, CubeSample
from irlos_pipe.paper.common.observation import noise_of
from irlos_pipe.paper.common.ramps import TTF, Knowledge, calibrated
from irlos_pipe.paper.common.reads import Read, as_read
from irlos_pipe.paper.slow_loop.frames import FrameTable, frame_table
from irlos_pipe.paper.slow_loop.loops import Loop, close_loops
from irlos_pipe.paper.slow_loop.sensor import FocusSensor, focus_sensor
from irlos_pipe.simulate.scene import Scene

Noise = Callable[[float, int], float]
"""Noise of a measurement [nm RMS] of a star of some magnitude, from a number of one-second frames."""

UNCALIBRATED = "uncalibrated"
SKY_STREAM, CUBE_STREAM, DRIFT_STREAM, NOISE_STREAM = range(4)  # children of a sample's seed
DRIFT_STEPS = 10  # per frame
SEEN = 0.85  # part of the aperture's photons in the window: hole, spider and halo take the rest
SKY_FOCUS_NM = 5.0  # defocus of the AO residual in a frame of a second, as simulated


@dataclass(frozen=True)
class Conditions:
    """Telescope, sky and calibration that all loops share; `delay` as in `Integrator`.

    Attributes
    ----------
    read : Read or None
        Of which the loops' exposures are the sum, with the light of the sky; None: one read without sky.
    """

    facility: Facility
    drift: Drift
    delay: int
    seeing_arcsec: float
    calibration_frames: int
    read: Read | None = None


@dataclass(frozen=True)
class LoopSample:
    """One sky with its NCPAs, and the loops that run on it.

    Attributes
    ----------
    configurations : tuple of str
        The sensors that the loops name: calibration methods, or `UNCALIBRATED`.
    frames, drifts : int
        Frames of a second per drift, and drifts.
    reach_nm, nodes
        See `frame_table`; a loop whose residual exceeds the reach has diverged.
    """

    name: str
    seed: tuple[int, ...]
    conditions: Conditions
    configurations: tuple[str, ...]
    loops: tuple[Loop, ...]
    frames: int
    drifts: int
    reach_nm: float = 240.0
    nodes: int = 8


def run_loops(sample: LoopSample) -> dict[str, np.ndarray]:
    """Calibrate the NCPAs of a sample and run its loops.

    Returns
    -------
    dict of str to ndarray
        The fields of `LoopRecord`, (drifts, loops, frames); ``drift_nm`` (drifts, frames);
        ``sky_focus_nm`` (frames,); ``bound_nm`` (loops,), the Cramér–Rao bound of one measurement.
    """
    cube = _cube(sample)
    bare = _star(sample, cube.ncpa_nm)
    scenes = {loop.exposures: _exposed_for(bare, loop.exposures, sample.conditions) for loop in sample.loops}
    methods = [name for name in sample.configurations if name != UNCALIBRATED]
    known = calibrated(cube, methods) if methods else {}
    sensors = {name: focus_sensor(bare, known.get(name, Knowledge())) for name in sample.configurations}
    table = frame_table(bare, sample.reach_nm, sample.nodes)
    drift_nm = np.array([_drift_nm(sample, index) for index in range(sample.drifts)])
    records = [
        close_loops(
            sample.loops, sensors, scenes, table, one, sample.conditions.delay, _noise_rng(sample, index)
        )
        for index, one in enumerate(drift_nm)
    ]
    return {
        **{name: np.array([getattr(one, name) for one in records]) for name in vars(records[0])},
        "drift_nm": drift_nm,
        "sky_focus_nm": table.sky_focus_nm,
        "bound_nm": _bounds_nm(sample.loops, sensors, scenes, table),
    }


def _cube(sample: LoopSample) -> Scene:
    """The recording that the NCPAs are calibrated on."""
    conditions = sample.conditions
    cube = CubeSample(
        f"{sample.name}, calibration",
        (*sample.seed, CUBE_STREAM),
        conditions.facility,
        conditions.seeing_arcsec,
        conditions.calibration_frames,
        BRIGHT_MAG_J,
    ).scene()
    ncpa_nm = {noll: value for noll, value in cube.ncpa_nm.items() if noll not in TTF}
    return replace(cube, ncpa_nm=ncpa_nm, sampling=FINE)


def _star(sample: LoopSample, ncpa_nm: Mapping[int, float]) -> Scene:
    """One-second frames of the brightest star."""
    conditions = sample.conditions
    return star_scene(
        sample.name,
        conditions.facility,
        (*sample.seed, SKY_STREAM),
        sample.frames,
        min(loop.mag_j for loop in sample.loops),
        ncpa_nm,
        seeing_arcsec=conditions.seeing_arcsec,
    )


def _exposed_for(star: Scene, frames: int, conditions: Conditions) -> Scene:
    """The same star in exposures of so many frames, with the noise of their reads."""
    exposure_s = frames * star.exposure_s
    return as_read(replace(star, exposure_s=exposure_s, frame_rate_hz=1 / exposure_s), conditions.read)


def _drift_nm(sample: LoopSample, index: int) -> np.ndarray:
    """Mean defocus of the disturbance in every frame, (frames,)."""
    rng = np.random.default_rng([*sample.seed, DRIFT_STREAM, index])
    steps = sample.conditions.drift.draw_nm(rng, sample.frames * DRIFT_STEPS, 1 / DRIFT_STEPS)
    return steps.reshape(sample.frames, DRIFT_STEPS).mean(1)


def _noise_rng(sample: LoopSample, index: int) -> np.random.Generator:
    return np.random.default_rng([*sample.seed, NOISE_STREAM, index])


def _bounds_nm(
    loops: Sequence[Loop],
    sensors: Mapping[str, FocusSensor],
    scenes: Mapping[int, Scene],
    table: FrameTable,
) -> np.ndarray:
    """Cramér–Rao bound of one measurement of every loop, with its own sensor's model."""
    seen_e = float(table.images_e(0, np.zeros(1)).sum())
    return np.array(
        [
            sensors[loop.sensor].bound_nm(
                seen_e * loop.brightness(scenes[loop.exposures].mag_j) * loop.exposures,
                noise_of(scenes[loop.exposures]),
            )
            for loop in loops
        ]
    )


# -- which loops are worth running -----------------------------------------------------------------


def noise_law(conditions: Conditions) -> Noise:
    """Return the expected noise of a measurement, for the choice of gains: photons, and the sky's defocus."""
    scene = star_scene("noise", conditions.facility, (0,), 1, 0.0, {}, seeing_arcsec=conditions.seeing_arcsec)
    sensor = focus_sensor(scene, Knowledge())

    def noise_nm(mag_j: float, exposures: int) -> float:
        seen_e = SEEN * scene.photons * 10 ** (-0.4 * mag_j) * exposures
        noise = noise_of(_exposed_for(scene, exposures, conditions))
        return float(np.hypot(sensor.bound_nm(seen_e, noise), SKY_FOCUS_NM / np.sqrt(exposures)))

    return noise_nm


def at_best_gain(
    sensor: str, magnitudes: Sequence[float], drift: Drift, delay: int, noise: Noise, exposures: int = 1
) -> list[Loop]:
    """Return one loop per star, at the gain with the smallest predicted residual.

    Parameters
    ----------
    sensor, exposures
        See `Loop`.
    magnitudes : sequence of float
        Of the stars.
    drift, delay
        See `Integrator.residual_nm`.
    noise : callable
        See `noise_law`.
    """
    gains = [best_gain(drift, noise(mag_j, exposures), float(exposures), delay) for mag_j in magnitudes]
    return [
        Loop(sensor, mag_j, round(gain, 3), exposures) for mag_j, gain in zip(magnitudes, gains, strict=True)
    ]


def gain_scan(sensor: str, magnitudes: Sequence[float], gains: Sequence[float]) -> list[Loop]:
    """Return a loop with `sensor` for every one of `gains` on every star of `magnitudes`."""
    return [Loop(sensor, mag_j, gain) for mag_j in magnitudes for gain in gains]
