"""Image motion: slow wander and the vibration lines of the telescope; blur within a frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from scipy.special import j0

from irlos_pipe.conventions.facility import VibrationLine
from irlos_pipe.conventions.keys import key
from irlos_pipe.simulate import SceneError

SHORTEST_STEP_S = 1 / 800  # eight samples per period of the fastest line of UT4


@dataclass(frozen=True)
class Motion:
    """Long-term statistics of the image motion; without `lines` of its own it has those of the facility.

    The slow wander has what the lines leave of the variance; a line is ``1 / (π coherence)`` wide.
    """

    rms_mas: float = key(7.0, "per axis", ge=0, le=200)
    lines: tuple[VibrationLine, ...] | None = key(None, "vibrations: {hz, share_x, share_y}")
    wander_hz: float = key(4.0, "corner frequency of the slow wander", gt=0, le=200)
    line_coherence_s: float = key(1.0, "time over which a line keeps its phase", gt=0, le=1e4)

    def __post_init__(self) -> None:
        for line in range(1, 3):
            total = sum(one[line] for one in self.lines or ())
            if total > 1:
                axis = VibrationLine._fields[line]
                raise SceneError(f"lines: the values of {axis} add up to {total:g}, more than 1")


class MotionSeries:
    """Image motion from one moment to the next, drawn from `rng`.

    A vibration is the real part of a complex first-order autoregressive process that turns with the
    line's frequency: exact at any step, and stationary from the first sample. They are `lines`, unless the
    `motion` has its own.
    """

    def __init__(self, motion: Motion, lines: Sequence[VibrationLine], rng: np.random.Generator):
        table = np.array(lines if motion.lines is None else motion.lines, float).reshape(-1, 3)
        shares = np.vstack([1 - table[:, 1:].sum(axis=0), table[:, 1:]])
        self._rms_mas = motion.rms_mas * np.sqrt(shares)  # (components, 2)
        decay = np.append(2 * np.pi * motion.wander_hz, np.full(len(table), 1 / motion.line_coherence_s))
        self._rate = -decay + 2j * np.pi * np.append(0.0, table[:, 0])  # (components,) [1/s]
        self._rng = rng
        self._state = self._noise(1)[0]

    def _noise(self, steps: int) -> np.ndarray:
        """Complex normal numbers, unit variance of the real part, (steps, components, 2)."""
        parts = self._rng.standard_normal((steps, *self._rms_mas.shape, 2))
        return parts[..., 0] + 1j * parts[..., 1]

    def skip(self, time_s: float) -> None:
        """Let `time_s` pass unobserved."""
        self.next_mas(time_s, 1)

    def next_mas(self, step_s: float, steps: int) -> np.ndarray:
        """Return positions (x, y) after each of the next `steps` of `step_s`, (steps, 2) [mas]."""
        memory = np.exp(self._rate * step_s)
        drive = self._noise(steps) * np.sqrt(1 - np.abs(memory) ** 2)[:, None]
        track = np.empty_like(drive)
        for component, factor in enumerate(memory):
            start = (factor * self._state[component])[None]
            track[:, component] = lfilter([1.0], [1.0, -factor], drive[:, component], axis=0, zi=start)[0]
        self._state = track[-1]
        return np.sum(track.real * self._rms_mas, axis=1)


@dataclass(frozen=True)
class MotionBlur:
    mean_mas: np.ndarray  # (2,): mean displacement of the image (x, y)
    covariance_mas2: np.ndarray  # (2, 2): of its Gaussian part
    sinusoid_mas: np.ndarray  # (2,): amplitude vector of its sinusoidal part

    def __add__(self, other: "MotionBlur") -> "MotionBlur":
        """Two independent motions together; at most one of them is sinusoidal."""
        return MotionBlur(
            self.mean_mas + other.mean_mas,
            self.covariance_mas2 + other.covariance_mas2,
            self.sinusoid_mas + other.sinusoid_mas,
        )

    def transfer(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Return the mean of exp(-2πi f·position) at frequencies `fx`, `fy` [1/mas], which broadcast."""
        (xx, xy), (_, yy) = self.covariance_mas2
        spread = xx * fx**2 + 2 * xy * fx * fy + yy * fy**2
        shift = self.mean_mas[0] * fx + self.mean_mas[1] * fy
        swing = self.sinusoid_mas[0] * fx + self.sinusoid_mas[1] * fy
        return np.exp(-2 * np.pi**2 * spread - 2j * np.pi * shift) * j0(2 * np.pi * swing)


STILL = MotionBlur(np.zeros(2), np.zeros((2, 2)), np.zeros(2))
