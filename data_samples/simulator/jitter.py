"""Residual image motion: slow wander plus a vibration line of the telescope."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

VIBRATION_HZ = 48.3
VIBRATION_DAMPING = 0.01
VIBRATION_SHARE = 0.35  # part of the variance
WANDER_BANDWIDTH_HZ = 4.0


def autoregressive(coefficients: tuple[float, float], steps: int, rng: np.random.Generator) -> np.ndarray:
    """Return a stationary series x_k = c1 x_{k-1} + c2 x_{k-2} + noise of unit variance, (steps,)."""
    c1, c2 = coefficients
    drive = np.sqrt((1 + c2) * ((1 - c2) ** 2 - c1**2) / (1 - c2))
    settling = 2000 + steps
    series = lfilter([drive], [1.0, -c1, -c2], rng.standard_normal(settling + steps))
    return series[settling:]


def vibration_coefficients(frequency_hz: float, damping: float, step_s: float) -> tuple[float, float]:
    """Return the AR(2) coefficients of a damped oscillator sampled every step_s."""
    turn = 2 * np.pi * frequency_hz * step_s
    decay = np.exp(-damping * turn)
    return 2 * decay * np.cos(turn * np.sqrt(1 - damping**2)), -(decay**2)


def jitter_mas(rms_mas: float, step_s: float, steps: int, rng: np.random.Generator) -> np.ndarray:
    """Return image motion in x and y, (steps, 2) [mas], rms_mas per axis over a long time."""
    vibration = vibration_coefficients(VIBRATION_HZ, VIBRATION_DAMPING, step_s)
    wander = (float(np.exp(-2 * np.pi * WANDER_BANDWIDTH_HZ * step_s)), 0.0)
    axes = [
        np.sqrt(VIBRATION_SHARE) * autoregressive(vibration, steps, rng)
        + np.sqrt(1 - VIBRATION_SHARE) * autoregressive(wander, steps, rng)
        for _ in range(2)
    ]
    return rms_mas * np.stack(axes, axis=1)
