"""Image motion within a frame as a factor on the image's spectrum."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import j0


@dataclass(frozen=True)
class MotionBlur:
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

    def __add__(self, other: MotionBlur) -> MotionBlur:
        """Two independent motions together; at most one of them is sinusoidal."""
        return MotionBlur(
            self.mean_mas + other.mean_mas,
            self.covariance_mas2 + other.covariance_mas2,
            self.sinusoid_mas + other.sinusoid_mas,
        )

    def transfer(self, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Return the mean of exp(-2πi f·position), the characteristic function of the positions.

        Parameters
        ----------
        fx, fy : ndarray, shapes that broadcast
            Spatial frequencies [1/mas].
        """
        (xx, xy), (_, yy) = self.covariance_mas2
        spread = xx * fx**2 + 2 * xy * fx * fy + yy * fy**2
        shift = self.mean_mas[0] * fx + self.mean_mas[1] * fy
        swing = self.sinusoid_mas[0] * fx + self.sinusoid_mas[1] * fy
        return np.exp(-2 * np.pi**2 * spread - 2j * np.pi * shift) * j0(2 * np.pi * swing)


STILL = MotionBlur(np.zeros(2), np.zeros((2, 2)), np.zeros(2))
