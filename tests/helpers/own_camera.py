"""Frames of a camera on a telescope of 4.2 m, by NumPy alone: own Noll modes, own Fourier sums, own pupil."""

from collections.abc import Mapping
from math import factorial

import numpy as np

DIAMETER_M, OBSCURATION, VANES_DEG, VANE_M = 4.2, 0.29, (35, 145, 215, 325), 0.03
SCALE_MAS, SAMPLES, PARTS = 20.0, 210, 5  # pupil samples across, and parts of each per side
PIXEL_PARTS, GAIN_E, READ_NOISE_E = 3, 2.1, 4.0


def noll_mode(noll: int, radius: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Noll 1976, table I: unit RMS on the unit disc, even modes are cosines."""
    n = next(order for order in range(100) if (order + 1) * (order + 2) // 2 >= noll)
    several = sorted(m for m in range(n % 2, n + 1, 2) for _ in range(2 if m else 1))
    m = several[noll - n * (n + 1) // 2 - 1]
    radial = np.zeros_like(radius)
    for k in range((n - m) // 2 + 1):
        below = factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k)
        radial += (-1) ** k * factorial(n - k) / below * radius ** (n - 2 * k)
    turn = np.sqrt(2) * (np.sin(m * angle) if noll % 2 else np.cos(m * angle)) if m else 1.0
    return np.sqrt(n + 1) * radial * turn


def pupil() -> np.ndarray:
    """Transmission (rows, columns): the mean over the parts of each sample."""
    axis = (np.arange(SAMPLES * PARTS) - (SAMPLES * PARTS - 1) / 2) * DIAMETER_M / SAMPLES / PARTS
    place = axis + 1j * axis[:, None]
    clear = (np.abs(place) <= DIAMETER_M / 2) & (np.abs(place) >= OBSCURATION * DIAMETER_M / 2)
    for angle in np.radians(VANES_DEG):
        along = place * np.exp(-1j * angle)
        clear &= (along.real < 0) | (np.abs(along.imag) > VANE_M / 2)
    return clear.reshape(SAMPLES, PARTS, SAMPLES, PARTS).mean(axis=(1, 3))


def frames(
    zernike_nm: Mapping[int, float], count: int = 20, window: int = 48, nm: float = 1600.0, seed: int = 1
) -> np.ndarray:
    """Frames [ADU] of a star of 3.8e5 electrons that moves by 0.3 px, (count, window, window)."""
    rng, axis = np.random.default_rng(seed), (np.arange(SAMPLES) - (SAMPLES - 1) / 2) * DIAMETER_M / SAMPLES
    u, clear = 2 * (axis + 1j * axis[:, None]) / DIAMETER_M, pupil()
    opd_nm = sum((c * noll_mode(noll, abs(u), np.angle(u)) for noll, c in zernike_nm.items()), 0 * u.real)
    field = clear * np.exp(2j * np.pi * opd_nm / nm)
    place = (np.arange(window * PIXEL_PARTS) - (window * PIXEL_PARTS - 1) / 2) / PIXEL_PARTS
    step_rad = SCALE_MAS * np.pi / 180 / 3600e3
    unit = (DIAMETER_M / SAMPLES * step_rad / PIXEL_PARTS / (nm * 1e-9)) ** 2 / np.sum(clear**2)
    found = []
    for motion in rng.normal(0, 0.3, (count, 2)):
        column, row = (
            np.exp(-2j * np.pi * np.outer(place - shift, axis) * step_rad / (nm * 1e-9)) for shift in motion
        )
        light = unit * np.abs(row @ field @ column.T) ** 2
        image = light.reshape(window, PIXEL_PARTS, window, PIXEL_PARTS).sum(axis=(1, 3))
        found.append(rng.poisson(3.8e5 * image) + rng.normal(0, READ_NOISE_E, image.shape))
    return np.array(found) / GAIN_E
