"""Frames of a camera on a telescope of 4.2 m, by NumPy alone: own Noll modes, own Fourier sums, own pupil."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import factorial

import numpy as np

DIAMETER_M, OBSCURATION, VANES_DEG, VANE_M = 4.2, 0.29, (35, 145, 215, 325), 0.03
SCALE_MAS, SAMPLES, PARTS = 20.0, 210, 5  # pupil samples across, and parts of each per side
PIXEL_PARTS, GAIN_E, READ_NOISE_E = 3, 2.1, 4.0
MAS = np.pi / 180 / 3600e3


def noll_mode(noll: int, radius: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Noll 1976, table I: unit RMS on the unit disc, even modes are cosines."""
    n = next(order for order in range(100) if (order + 1) * (order + 2) // 2 >= noll)
    several = sorted(m for m in range(n % 2, n + 1, 2) for _ in range(2 if m else 1))
    m = several[noll - n * (n + 1) // 2 - 1]
    radial = sum(
        (-1) ** k
        * factorial(n - k)
        / (factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k))
        * radius ** (n - 2 * k)
        for k in range((n - m) // 2 + 1)
    )
    turn = np.sqrt(2) * (np.sin(m * angle) if noll % 2 else np.cos(m * angle)) if m else 1.0
    return np.sqrt(n + 1) * radial * turn


def pupil() -> np.ndarray:
    """Transmission (rows, columns): the mean over the parts of each sample."""
    axis = (np.arange(SAMPLES * PARTS) - (SAMPLES * PARTS - 1) / 2) * DIAMETER_M / SAMPLES / PARTS
    x, y = np.meshgrid(axis, axis)
    radius = 2 * np.hypot(x, y) / DIAMETER_M
    clear = (radius <= 1) & (radius >= OBSCURATION)
    for angle in np.radians(VANES_DEG):
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        clear &= (along < 0) | (np.abs(across) > VANE_M / 2)
    return clear.reshape(SAMPLES, PARTS, SAMPLES, PARTS).mean(axis=(1, 3))


def frames(
    zernike_nm: Mapping[int, float],
    count: int = 20,
    window: int = 48,
    nm: Sequence[float] = (1600.0,),
    seed: int = 1,
    motion_px: float = 0.3,
) -> np.ndarray:
    """Frames [ADU] of a star of 3.8e5 electrons that moves, (count, window, window)."""
    rng, axis = np.random.default_rng(seed), (np.arange(SAMPLES) - (SAMPLES - 1) / 2) * DIAMETER_M / SAMPLES
    x, y = np.meshgrid(axis, axis)
    radius, angle, clear = 2 * np.hypot(x, y) / DIAMETER_M, np.arctan2(y, x), pupil()
    opd_nm = sum((c * noll_mode(noll, radius, angle) for noll, c in zernike_nm.items()), np.zeros_like(x))
    place = (np.arange(window * PIXEL_PARTS) - (window * PIXEL_PARTS - 1) / 2) / PIXEL_PARTS
    found = []
    for motion in rng.normal(0, motion_px, (count, 2)):
        image = np.zeros((window, window))
        for wavelength_nm in nm:
            column, row = (
                np.exp(-2j * np.pi * np.outer(place - shift, axis) * SCALE_MAS * MAS / (wavelength_nm * 1e-9))
                for shift in motion
            )
            light = np.abs(row @ (clear * np.exp(2j * np.pi * opd_nm / wavelength_nm)) @ column.T) ** 2
            light *= (DIAMETER_M / SAMPLES * SCALE_MAS * MAS / PIXEL_PARTS / (wavelength_nm * 1e-9)) ** 2
            parts = (window, PIXEL_PARTS, window, PIXEL_PARTS)
            image += light.reshape(parts).sum(axis=(1, 3)) / np.sum(clear**2) / len(nm)
        electrons = rng.poisson(3.8e5 * image) + rng.normal(0, READ_NOISE_E, image.shape)
        found.append(electrons / GAIN_E)
    return np.array(found)
