"""Linear theory of the slow loop: what an integrator with delay leaves of a drift, and which gain is best.

Frame k is exposed while the command stays at ``c_k``; its measurement ``m_k`` is ready `delay` frames
after the exposure has ended: ``c_{k+1+delay} = c_{k+delay} + gain · m_k``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from irlos_pipe.control.disturbance import Drift

GRID = 4096  # frequencies up to Nyquist's, in the integral over the spectrum
ALIASES = 30  # replicas of the spectrum on each side; the mean over a frame damps them by f^-4


@dataclass(frozen=True)
class Integrator:
    """An integrating controller with delay, as linear theory sees it."""

    gain: float
    frame_s: float = 1.0  # exposure time, and time between two frames
    delay: int = 1  # whole frames between the end of an exposure and the command that follows from it

    @property
    def largest_stable_gain(self) -> float:
        """Return the gain above which the poles of ``z^(delay+1) - z^delay + gain`` leave the unit circle."""
        return float(2 * np.sin(np.pi / (2 * (2 * self.delay + 1))))

    def gain_margin(self, sensor_slope: float) -> float:
        """Return the factor by which the gain could grow before the loop oscillates."""
        return self.largest_stable_gain / (self.gain * sensor_slope)

    def rejection(self, f_hz: np.ndarray, sensor_slope: float = 1.0) -> np.ndarray:
        """Return residual over disturbance, means over frames, complex, at `f_hz`, (frequencies,).

        A sensor's slope is its measured over the true residual, here and below.
        """
        z1 = np.exp(-2j * np.pi * f_hz * self.frame_s)
        return (1 - z1) / (1 - z1 + self.gain * sensor_slope * z1 ** (1 + self.delay))

    def noise_transfer(self, f_hz: np.ndarray, sensor_slope: float = 1.0) -> np.ndarray:
        """Return residual over noise of the measurement, complex."""
        z1 = np.exp(-2j * np.pi * f_hz * self.frame_s)
        return -self.gain * z1 ** (1 + self.delay) / (1 - z1) * self.rejection(f_hz, sensor_slope)

    def residual_nm(self, drift: Drift, noise_nm: float, sensor_slope: float = 1.0) -> float:
        """Return the RMS defocus that drift and white measurement noise leave; infinite if unstable.

        It is the mean over time, what wanders within a frame included; `noise_nm` is that of a measurement
        [nm RMS].
        """
        if self.gain * sensor_slope >= self.largest_stable_gain:
            return float("inf")
        f_hz, width_hz = self._frequencies()
        followed = np.abs(self.rejection(f_hz, sensor_slope)) ** 2 * self._frame_mean_psd(drift, f_hz)
        noise = np.mean(np.abs(self.noise_transfer(f_hz, sensor_slope)) ** 2) * noise_nm**2
        return float(np.sqrt(followed.sum() * width_hz + noise + drift.wander_within_nm2(self.frame_s)))

    def _frequencies(self) -> tuple[np.ndarray, float]:
        """Midpoints of equal intervals up to Nyquist's frequency, and their width [Hz]."""
        width_hz = 0.5 / self.frame_s / GRID
        return (np.arange(GRID) + 0.5) * width_hz, width_hz

    def _frame_mean_psd(self, drift: Drift, f_hz: np.ndarray) -> np.ndarray:
        """One-sided spectrum of the means over frames, replicas folded in [nm²/Hz]."""
        replicas = f_hz[:, None] + np.arange(-ALIASES, ALIASES + 1) / self.frame_s
        return np.sum(drift.psd_nm2_hz(np.abs(replicas)) * np.sinc(replicas * self.frame_s) ** 2, axis=1)


def best_gain(drift: Drift, noise_nm: float, frame_s: float = 1.0, delay: int = 1) -> float:
    """Return the gain with the smallest residual, see `Integrator`."""
    limit = Integrator(1.0, frame_s, delay).largest_stable_gain
    found = minimize_scalar(
        lambda log_gain: Integrator(np.exp(log_gain), frame_s, delay).residual_nm(drift, noise_nm),
        bounds=(np.log(1e-3), np.log(0.95 * limit)),
        method="bounded",
    )
    return float(np.exp(found.x))
