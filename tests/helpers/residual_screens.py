"""Screens of an AO residual drawn by FFT, on the pupil of `reference_psf`: independent of the package."""

from collections.abc import Iterator

import numpy as np
from scipy.special import j1, jv

from helpers.optics_cases import BAND
from helpers.reference_psf import DIAMETER_M

PERIOD_M = 32.0
LOW_PER_M = 0.5 * BAND.low_per_m  # of longer waves tip and tilt are 92 % or more


def kept(f_per_m):
    """Variance of a wave over a clear circle that is not piston, tip or tilt (Noll 1976)."""
    z = np.pi * f_per_m * DIAMETER_M
    return 1 - (2 * j1(z) / z) ** 2 - 4 * (2 * jv(2, z) / z) ** 2


def screens_nm(
    imager, slope: float, rms_nm: float, count: int, seed: int, variance=1.0
) -> Iterator[np.ndarray]:
    """Screens of a power law inside the correction band, without tip and tilt over the pupil.

    The `variance` at the points of the pupil, (points,), is relative to that of a uniform screen.
    """
    samples = round(np.sqrt(imager.grid.size))
    size = round(samples * PERIOD_M / DIAMETER_M)
    f = np.fft.fftfreq(size, PERIOD_M / size)
    radius = np.maximum(np.hypot(f[:, None], f[None]), 1e-9)
    covered = np.clip((radius - LOW_PER_M) * PERIOD_M + 0.5, 0, 1)  # part of each cell inside the band
    covered *= np.clip((BAND.cutoff_per_m - radius) * PERIOD_M + 0.5, 0, 1)
    power = covered * radius**-slope
    amplitude = np.sqrt(power * rms_nm**2 / np.sum(power * kept(radius)))
    weight = imager.transmission / imager.transmission.sum()
    tilts = np.stack([np.ones(imager.grid.size), imager.grid.x, imager.grid.y])
    to_tilts = np.linalg.solve((tilts * weight) @ tilts.T, tilts * weight)
    rng = np.random.default_rng(seed)
    for _ in range(count // 2):
        noise = rng.standard_normal((2, size, size))
        pair = np.fft.fft2(amplitude * (noise[0] + 1j * noise[1]))[:samples, :samples]
        for one in (pair.real.ravel(), pair.imag.ravel()):
            screen = np.sqrt(variance) * one
            yield screen - (to_tilts @ screen) @ tilts
