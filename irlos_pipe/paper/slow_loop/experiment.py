"""The slow focus loop closed on LIFT: what the wandering sodium layer leaves, against the star's magnitude.

One sample is one sky with its own NCPAs, calibrated on a narrow-band cube as an observer would, and a
few drifts. All loops of a sample (configurations, stars, gains) run on the same sky and drifts. The NCPAs
have no tip, tilt and defocus: a loop drives those to zero by itself, and its own zero is what counts here.
The 2x2 mode that the full pupil replaces runs on the same drifts, with the same star and sky.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from irlos_pipe.control.disturbance import Drift
from irlos_pipe.control.linear_theory import best_gain
from irlos_pipe.conventions.facility import Facility
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.paper.common.broad_band import FINE, in_four_images, star_scene
from irlos_pipe.paper.common.cube import BRIGHT_MAG_J, CubeSample
from irlos_pipe.paper.common.observation import noise_of
from irlos_pipe.paper.common.ramps import TTF, Knowledge, calibrated
from irlos_pipe.paper.common.reads import Read, as_read
from irlos_pipe.paper.slow_loop.frames import FrameTable, frame_table
from irlos_pipe.paper.slow_loop.loops import Loop, LoopRecord, close_loops
from irlos_pipe.paper.slow_loop.sensor import focus_sensor
from irlos_pipe.paper.slow_loop.two_by_two import (
    TWO_BY_TWO,
    Sensor,
    two_by_two_sensors,
    with_their_zero,
)
from irlos_pipe.simulate.scene import Scene

Noise = Callable[[float, int], float]
"""Noise of a measurement [nm RMS] of a star of some magnitude, from a number of one-second frames."""

UNCALIBRATED = "uncalibrated"
# Children of a sample's seed; the last two are of the noise in the full-pupil and in the 2x2 mode.
SKY_STREAM, CUBE_STREAM, DRIFT_STREAM, *NOISE_STREAMS = range(5)
# Of the arrays that have one.
LOOP_AXIS = dict.fromkeys(LoopRecord.__annotations__, 1) | {"bound_nm": 0, "photon_noise_nm": 0}
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
        The sensors that the loops name: calibration methods, `UNCALIBRATED`, or those of the 2x2 mode.
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
        ``sky_focus_nm`` (frames,); ``bound_nm`` (loops,), the Cramér–Rao bound of one measurement;
        ``photon_noise_nm`` (loops,), see `FocusSensor.photon_noise_nm`.
    """
    cube = _cube(sample)
    star = _star(sample, cube.ncpa_nm)
    drift_nm = np.array([_drift_nm(sample, index) for index in range(sample.drifts)])
    in_four = np.array([loop.sensor in TWO_BY_TWO for loop in sample.loops])
    modes = ((star, ~in_four), (in_four_images(star), in_four))
    parts = [
        _in_mode(sample, list(compress(sample.loops, chosen)), scene, cube, drift_nm, stream)
        for (scene, chosen), stream in zip(modes, NOISE_STREAMS, strict=True)
        if chosen.any()
    ]
    order = np.argsort(np.concatenate([np.flatnonzero(chosen) for _, chosen in modes]))
    joined = {
        name: np.concatenate([part[name] for part in parts], axis).take(order, axis)
        for name, axis in LOOP_AXIS.items()
    }
    return {**joined, "drift_nm": drift_nm, "sky_focus_nm": parts[0]["sky_focus_nm"]}


def _in_mode(
    sample: LoopSample, loops: Sequence[Loop], star: Scene, cube: Scene, drift_nm: np.ndarray, stream: int
) -> dict[str, np.ndarray]:
    """The `loops` of one mode of the sensor, which sees a `star`."""
    scenes = {loop.exposures: _exposed_for(star, loop.exposures, sample.conditions) for loop in loops}
    table = frame_table(star, sample.reach_nm, sample.nodes)
    sensors = _sensors(sample, star, cube, table)
    rngs = [np.random.default_rng([*sample.seed, stream, index]) for index in range(sample.drifts)]
    records = [
        close_loops(loops, sensors, scenes, table, one, sample.conditions.delay, rng)
        for one, rng in zip(drift_nm, rngs, strict=True)
    ]
    own = [sensors[loop.sensor] for loop in loops]
    seeing = list(zip(own, _photons(loops, scenes, table), strict=True))
    return {
        **{name: np.array([getattr(one, name) for one in records]) for name in vars(records[0])},
        "sky_focus_nm": table.sky_focus_nm,
        "bound_nm": np.array([sensor.bound_nm(*seen) for sensor, seen in seeing]),
        "photon_noise_nm": np.array([sensor.photon_noise_nm(*seen) for sensor, seen in seeing]),
    }


def _sensors(sample: LoopSample, star: Scene, cube: Scene, table: FrameTable) -> dict[str, Sensor]:
    """What measures the defocus of a `star`, by name, the NCPAs calibrated on a `cube`."""
    if star.lenslets > 1:
        return with_their_zero(two_by_two_sensors(star), table)
    names = [name for name in sample.configurations if name not in TWO_BY_TWO]
    methods = [name for name in names if name != UNCALIBRATED]
    known = calibrated(cube, methods) if methods else {}
    return {name: focus_sensor(star, known.get(name, Knowledge())) for name in names}


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


def _photons(
    loops: Sequence[Loop], scenes: Mapping[int, Scene], table: FrameTable
) -> list[tuple[float, NoiseModel]]:
    """Electrons in the window and noise of an exposure of every loop."""
    seen_e = float(table.images_e(0, np.zeros(1)).sum())
    return [
        (
            seen_e * loop.brightness(scenes[loop.exposures].mag_j) * loop.exposures,
            noise_of(scenes[loop.exposures]),
        )
        for loop in loops
    ]


# -- which loops are worth running -----------------------------------------------------------------


def noise_law(conditions: Conditions, sensor: str = UNCALIBRATED) -> Noise:
    """Return the expected noise of a measurement, for the choice of gains: photons, and the sky's defocus.

    Parameters
    ----------
    conditions : Conditions
    sensor : str
        Of the 2x2 mode, or any of the full pupil.
    """
    scene = star_scene("noise", conditions.facility, (0,), 1, 0.0, {}, seeing_arcsec=conditions.seeing_arcsec)
    if sensor in TWO_BY_TWO:
        scene = in_four_images(scene)
        measuring = two_by_two_sensors(scene)[sensor]
    else:
        measuring = focus_sensor(scene, Knowledge())

    def noise_nm(mag_j: float, exposures: int) -> float:
        seen_e = SEEN * scene.photons * 10 ** (-0.4 * mag_j) * exposures
        noise = noise_of(_exposed_for(scene, exposures, conditions))
        return float(np.hypot(measuring.photon_noise_nm(seen_e, noise), SKY_FOCUS_NM / np.sqrt(exposures)))

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
