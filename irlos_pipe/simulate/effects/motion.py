"""Image motion within a frame: `tip_tilt_jitter` and `vibration`.

The image runs through the distribution of its positions, which blurs it. Besides, a frame sees a finite
piece of the motion, so that it is displaced a little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from irlos_pipe.conventions.facility import VibrationLine
from irlos_pipe.simulate.effects.base import MotionEffect, own, wider
from irlos_pipe.simulate.errors import SceneError, require_known
from irlos_pipe.simulate.motion_blur import MotionBlur

JITTER_CORRELATION_S = 0.010
FAST_HZ = 20.0  # a vibration of no given frequency is the strongest line above
Shape = Literal["sinusoidal", "gaussian"]


@dataclass(frozen=True)
class TipTiltJitter(MotionEffect):
    """Isotropic Gaussian motion; the mean of a frame is that of its independent positions."""

    name = "tip_tilt_jitter"
    sigma_mas: float = wider(0.0, 200.0)
    correlation_s: float = own("s, time after which the image has moved on", 1e-6, 10.0, JITTER_CORRELATION_S)

    def blur(self, exposure_s: float, lines: Sequence[VibrationLine], rng: np.random.Generator) -> MotionBlur:
        """See `MotionEffect.blur`."""
        positions = max(exposure_s / self.correlation_s, 1.0)
        mean_mas = self.sigma_mas / np.sqrt(positions) * rng.standard_normal(2)
        return MotionBlur(mean_mas, self.sigma_mas**2 * np.eye(2), np.zeros(2))


@dataclass(frozen=True)
class Vibration(MotionEffect):
    """Motion along `angle_deg`, of random phase; what is left of the last period displaces the frame.

    Without `frequency_hz` it is that of the telescope's strongest line above `FAST_HZ`.
    """

    name = "vibration"
    sigma_mas: float = wider(0.0, 200.0)
    angle_deg: float = 0.0
    frequency_hz: float | None = own(
        "Hz; the telescope's strongest line above 20 Hz if left out", 1e-3, 1000.0
    )
    shape: Shape = field(default="sinusoidal", metadata={"formerly": "distribution"})

    def __post_init__(self) -> None:
        require_known("effects.vibration.shape", [self.shape], get_args(Shape))

    def blur(self, exposure_s: float, lines: Sequence[VibrationLine], rng: np.random.Generator) -> MotionBlur:
        """See `MotionEffect.blur`."""
        angle = np.deg2rad(self.angle_deg)
        direction = self.sigma_mas * np.array([np.cos(angle), np.sin(angle)])
        cycles = (self.frequency_hz or _strongest_hz(lines)) * exposure_s
        mean_mas = np.sqrt(2) * direction * np.sinc(cycles) * np.cos(2 * np.pi * rng.random())
        if self.shape == "gaussian":
            return MotionBlur(mean_mas, np.outer(direction, direction), np.zeros(2))
        return MotionBlur(mean_mas, np.zeros((2, 2)), np.sqrt(2) * direction)


def _strongest_hz(lines: Sequence[VibrationLine]) -> float:
    fast = [line for line in lines if line[0] > FAST_HZ]
    if not fast:
        raise SceneError("effects.vibration: the instrument states no vibration line; give frequency_hz")
    return max(fast, key=lambda line: line[1] + line[2])[0]
