"""Residual wavefront of an adaptive optics that is simulated end to end.

Nothing in it is a spectrum of the residual: four layers of turbulence (HCIPy) drift over the pupil, a
Shack-Hartmann sensor on a laser star measures them through its cone, a regularised reconstructor drives
a mirror with a delay of two steps, and a slower loop on the natural star holds tip and tilt. Sizes are
those of a facility like that of UT4 (40 by 40 subapertures at 1 kHz); profile, winds and noise are
typical ones, not measured.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from hcipy import Cn_squared_from_fried_parameter, InfiniteAtmosphericLayer, make_pupil_grid

from simulator.atmosphere import OUTER_SCALE_M, fried_parameter_m
from simulator.telescope import DIAMETER_M, Telescope, ut4_aperture

REFERENCE_M = 500e-9
LOOP_S = 0.001
SUBAPERTURE_M = 0.2
SUBAPERTURES = 42  # across the grid; the outermost are outside the pupil
SAMPLES_PER_SUBAPERTURE = 3
SAMPLES = SUBAPERTURES * SAMPLES_PER_SUBAPERTURE  # of the loop's grid, along an axis
STEP_M = SUBAPERTURE_M / SAMPLES_PER_SUBAPERTURE
LIT_SHARE = 0.5  # lit part of its area that a subaperture needs to be used
GAIN, LEAK = 0.4, 0.005
DELAY_STEPS = 2
REGULARISATION = 0.01  # relative to the mean diagonal of the normal matrix
SLOPE_NOISE_NM = 100.0  # OPD across a subaperture: 0.1 arcsec
TIP_TILT_STEPS = 5  # the natural star is read at 200 Hz
TIP_TILT_GAIN = 0.4
LASER_STAR_M = 90e3
WARM_UP_S = 0.5


@dataclass(frozen=True)
class Layer:
    """Turbulence at one height: its share of Cn2 and its wind."""

    height_m: float
    share: float
    wind_m_s: tuple[float, float]


LAYERS = (
    Layer(0.0, 0.60, (6.0, 3.0)),
    Layer(1_500.0, 0.18, (-4.0, 9.0)),
    Layer(5_000.0, 0.14, (14.0, -6.0)),
    Layer(11_000.0, 0.08, (24.0, 12.0)),
)


class ClosedLoop:
    """Sequence of residual wavefronts behind the loop, in place of `ResidualScreens`.

    The time between two screens, `step_s`, is a multiple of the loop's step.
    """

    def __init__(self, telescope: Telescope, seeing_arcsec: float, step_s: float, rng: np.random.Generator):
        self._rng = rng
        self._steps = round(step_s / LOOP_S)
        self._hardware = build_hardware()
        self.to_pupil = _linear(centres(telescope.transmission.shape[0], telescope.step_m), 1.0)
        strength = Cn_squared_from_fried_parameter(fried_parameter_m(seeing_arcsec), REFERENCE_M)
        self._layers = [
            _moving(layer, strength, seed) for layer, seed in zip(LAYERS, rng.spawn(4), strict=True)
        ]
        actuators = self._hardware.actuators
        self._command_nm = np.zeros(actuators)
        self._on_its_way = deque([np.zeros(actuators)] * DELAY_STEPS)
        self._tip_tilt_nm, self._tip_tilt_seen = np.zeros(2), []
        self._clock = 0
        for _ in range(round(WARM_UP_S / LOOP_S)):
            self._advance()

    def next_nm(self) -> np.ndarray:
        """Advance to the next screen and return the OPD (n, n) [nm] on the telescope's grid."""
        for _ in range(self._steps):
            residual_nm = self._advance()
        return self.to_pupil @ residual_nm @ self.to_pupil.T

    def _advance(self) -> np.ndarray:
        """Make one step of the loop and return the OPD on its own grid [nm], piston removed."""
        hardware = self._hardware
        self._clock += 1
        screens_nm = [opd_at(layer, self._clock * LOOP_S) for layer in self._layers]
        mirror_nm = hardware.mirror_nm(self._on_its_way.popleft())
        residual_nm = np.sum(screens_nm, axis=0) - mirror_nm
        residual_nm -= np.tensordot(self._tip_tilt_nm, hardware.tip_tilt, axes=1)
        residual_nm -= np.mean(residual_nm[hardware.lit])
        self._correct_shape(screens_nm, mirror_nm)
        self._correct_tip_tilt(residual_nm)
        return residual_nm

    def _correct_shape(self, screens_nm: list[np.ndarray], mirror_nm: np.ndarray) -> None:
        hardware = self._hardware
        slopes = -hardware.slopes(mirror_nm, 0.0)
        for layer, screen_nm in zip(LAYERS, screens_nm, strict=True):
            slopes += hardware.slopes(screen_nm, layer.height_m)
        slopes += SLOPE_NOISE_NM / SUBAPERTURE_M * self._rng.standard_normal(slopes.shape)
        slopes -= slopes.mean(axis=1, keepdims=True)  # a laser star shows neither tip nor tilt
        step_nm = hardware.reconstructor @ slopes.ravel().astype(np.float32)
        self._command_nm = (1 - LEAK) * self._command_nm + GAIN * step_nm
        self._on_its_way.append(self._command_nm)

    def _correct_tip_tilt(self, residual_nm: np.ndarray) -> None:
        lit, modes = self._hardware.lit, self._hardware.tip_tilt
        self._tip_tilt_seen.append([np.mean(residual_nm[lit] * mode[lit]) for mode in modes])
        if len(self._tip_tilt_seen) == TIP_TILT_STEPS:
            self._tip_tilt_nm = self._tip_tilt_nm + TIP_TILT_GAIN * np.mean(self._tip_tilt_seen, axis=0)
            self._tip_tilt_seen = []


@dataclass(frozen=True)
class Hardware:
    """Sensor and mirror on the loop's grid of n x n samples."""

    lit: np.ndarray  # whether a sample is inside the pupil
    tip_tilt: np.ndarray  # (2, n, n): tilts along x and y, of unit RMS over the full disc
    # by height: mean over a subaperture, and difference of its edges per metre, of what the cone sees
    along: dict[float, np.ndarray]
    across: dict[float, np.ndarray]
    valid: np.ndarray  # which subapertures are used
    influence: np.ndarray  # (n, actuators on an edge): cubic B-splines; the mirror's is their product
    used: np.ndarray  # which actuators there are
    reconstructor: np.ndarray  # float32, (actuators, 2 x valid subapertures)

    @property
    def actuators(self) -> int:
        return int(self.used.sum())

    def mirror_nm(self, command_nm: np.ndarray) -> np.ndarray:
        """Return the OPD (n, n) [nm] of the mirror."""
        amplitudes = np.zeros(self.used.shape)
        amplitudes[self.used] = command_nm
        return self.influence @ amplitudes @ self.influence.T

    def slopes(self, opd_nm: np.ndarray, height_m: float) -> np.ndarray:
        """Return mean slopes along x and y of the valid subapertures, (2, valid) [nm/m]."""
        along, across = self.along[height_m], self.across[height_m]
        x, y = along @ opd_nm @ across.T, across @ opd_nm @ along.T
        return np.array([x[self.valid], y[self.valid]])


@lru_cache(1)
def build_hardware() -> Hardware:
    """Return sensor, mirror and reconstructor."""
    lit = np.asarray(ut4_aperture(_grid()).shaped) > 0.5
    position_m = centres(SAMPLES, STEP_M)
    tilt = np.broadcast_to(position_m / (DIAMETER_M / 4), lit.shape)
    mean = np.kron(np.eye(SUBAPERTURES), np.full(SAMPLES_PER_SUBAPERTURE, 1 / SAMPLES_PER_SUBAPERTURE))
    edges_m = (np.arange(SUBAPERTURES + 1) - SUBAPERTURES / 2) * SUBAPERTURE_M
    difference = np.diff(_linear(edges_m, 1.0), axis=0) / SUBAPERTURE_M
    cones = {layer.height_m: _linear(position_m, 1 - layer.height_m / LASER_STAR_M) for layer in LAYERS}
    valid = mean @ lit @ mean.T >= LIT_SHARE
    used = np.zeros((SUBAPERTURES + 1, SUBAPERTURES + 1), bool)
    for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):  # the corners of every valid subaperture
        used[row : row + SUBAPERTURES, column : column + SUBAPERTURES] |= valid
    influence = _cubic_spline((position_m[:, None] - edges_m) / SUBAPERTURE_M)
    return Hardware(
        lit=lit,
        tip_tilt=np.array([tilt, tilt.T]),
        along={height: mean @ cone for height, cone in cones.items()},
        across={height: difference @ cone for height, cone in cones.items()},
        valid=valid,
        influence=influence,
        used=used,
        reconstructor=_reconstructor(mean @ influence, difference @ influence, valid, used),
    )


def _reconstructor(along: np.ndarray, across: np.ndarray, valid: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return commands per slope: least squares with a penalty on the commands' squares."""
    x, y = (
        np.kron(rows, columns)[valid.ravel()][:, used.ravel()]
        for rows, columns in ((along, across), (across, along))
    )
    response = np.concatenate([x, y])
    normal = response.T @ response
    penalty = REGULARISATION * np.trace(normal) / len(normal) * np.eye(len(normal))
    return np.linalg.solve(normal + penalty, response.T).astype(np.float32)


def _grid():
    return make_pupil_grid(SAMPLES, SUBAPERTURES * SUBAPERTURE_M)


def _moving(layer: Layer, strength: float, rng: np.random.Generator) -> InfiniteAtmosphericLayer:
    velocity = np.array(layer.wind_m_s)
    return InfiniteAtmosphericLayer(_grid(), layer.share * strength, OUTER_SCALE_M, velocity, 0, 2, seed=rng)


def opd_at(layer: InfiniteAtmosphericLayer, time_s: float) -> np.ndarray:
    layer.evolve_until(time_s)
    return np.asarray(layer.phase_for(REFERENCE_M).shaped) * (REFERENCE_M * 1e9 / (2 * np.pi))


def centres(samples: int, step_m: float) -> np.ndarray:
    return (np.arange(samples) - (samples - 1) / 2) * step_m


def _linear(position_m: np.ndarray, scale: float) -> np.ndarray:
    """Return the matrix (positions, n) that interpolates rows of the loop's grid at scaled positions."""
    index = np.clip(np.asarray(position_m) * scale / STEP_M + (SAMPLES - 1) / 2, 0, SAMPLES - 1)
    return np.maximum(1 - np.abs(index[:, None] - np.arange(SAMPLES)), 0)


def _cubic_spline(distance: np.ndarray) -> np.ndarray:
    """Return the cubic B-spline of unit knots, one at its centre: a neighbour moves by a quarter."""
    d = np.abs(distance)
    inner, outer = 1 - 1.5 * d**2 + 0.75 * d**3, 0.25 * (2 - d) ** 3
    return np.where(d < 1, inner, np.where(d < 2, outer, 0.0))
