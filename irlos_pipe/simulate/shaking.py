"""Image motion of the effects: it runs through its distribution within a frame, which blurs the image.

The blur is a factor on the image's spectrum, the characteristic function of the positions. Besides, a
frame sees a finite piece of the motion, so its image is displaced a little.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import j0

from irlos_pipe.simulate.checks import require_known
from irlos_pipe.simulate.scene import Scene

JITTER_CORRELATION_S = 0.010
VIBRATION_HZ = 48.3  # the strongest line of UT4 above 20 Hz
DISTRIBUTIONS = ("sinusoidal", "gaussian")


@dataclass(frozen=True)
class Shake:
    """Motion within one frame.

    Attributes
    ----------
    mean_mas : ndarray, (2,)
        Mean displacement of the image (x, y).
    covariance_mas2 : ndarray, (2, 2)
        Of its Gaussian part.
    sinusoid_mas : ndarray, (2,)
        Amplitude vector of its sinusoidal part.
    """

    mean_mas: np.ndarray
    covariance_mas2: np.ndarray
    sinusoid_mas: np.ndarray

    def __add__(self, other: Shake) -> Shake:
        """Two independent motions together; at most one of them is sinusoidal."""
        return Shake(
            self.mean_mas + other.mean_mas,
            self.covariance_mas2 + other.covariance_mas2,
            self.sinusoid_mas + other.sinusoid_mas,
        )

    def transfer(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Mean of exp(-2πi f·position) for frequencies that broadcast [1/mas]."""
        (xx, xy), (_, yy) = self.covariance_mas2
        spread = xx * fx**2 + 2 * xy * fx * fy + yy * fy**2
        shift = self.mean_mas[0] * fx + self.mean_mas[1] * fy
        swing = self.sinusoid_mas[0] * fx + self.sinusoid_mas[1] * fy
        return np.exp(-2 * np.pi**2 * spread - 2j * np.pi * shift) * j0(2 * np.pi * swing)


STILL = Shake(np.zeros(2), np.zeros((2, 2)), np.zeros(2))


class Shaking:
    """Motion of the effects `tip_tilt_jitter` and `vibration`, frame after frame.

    Parameters
    ----------
    scene : Scene
    """

    def __init__(self, scene: Scene):
        self._exposure_s, self._rng = scene.exposure_s, scene.rng("effects")
        self._jitter = scene.effects.get("tip_tilt_jitter")
        self._vibration = scene.effects.get("vibration")
        if self._vibration is not None:
            shape = self._vibration.get("distribution", DISTRIBUTIONS[0])
            require_known("effects.vibration.distribution", [shape], DISTRIBUTIONS)

    @property
    def rms_mas(self) -> float:
        """RMS of the motion along its strongest direction."""
        effects = (effect for effect in (self._jitter, self._vibration) if effect)
        return float(np.sqrt(sum(effect["sigma_mas"] ** 2 for effect in effects)))

    def next_frame(self) -> Shake:
        """Motion within the next frame."""
        shake = STILL
        if self._jitter is not None:
            shake = shake + self._jittering(self._jitter)
        if self._vibration is not None:
            shake = shake + self._vibrating(self._vibration)
        return shake

    def _jittering(self, effect: Mapping[str, float]) -> Shake:
        """Isotropic and Gaussian; the mean of the frame is that of its independent positions."""
        sigma_mas = effect["sigma_mas"]
        positions = max(self._exposure_s / effect.get("correlation_s", JITTER_CORRELATION_S), 1.0)
        mean_mas = sigma_mas / np.sqrt(positions) * self._rng.standard_normal(2)
        return Shake(mean_mas, sigma_mas**2 * np.eye(2), np.zeros(2))

    def _vibrating(self, effect: Mapping[str, float]) -> Shake:
        """Sinusoidal along one direction, of random phase; what is left of the last period displaces."""
        angle = np.deg2rad(effect.get("angle_deg", 0.0))
        direction = effect["sigma_mas"] * np.array([np.cos(angle), np.sin(angle)])
        cycles = effect.get("frequency_hz", VIBRATION_HZ) * self._exposure_s
        mean_mas = np.sqrt(2) * direction * np.sinc(cycles) * np.cos(2 * np.pi * self._rng.random())
        if effect.get("distribution", DISTRIBUTIONS[0]) == "gaussian":
            return Shake(mean_mas, np.outer(direction, direction), np.zeros(2))
        return Shake(mean_mas, np.zeros((2, 2)), np.sqrt(2) * direction)
