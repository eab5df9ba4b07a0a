"""Cubes of a bright star behind an extreme adaptive-optics system, by matrix Fourier transforms.

The telescope is that of a 4.65 m stop with an obscuration of 0.49 in the K band: 3.8 pixels per λ/D, a bright
first ring, and speckles that change from frame to frame by more than the noise.
"""

from __future__ import annotations

import numpy as np

SAMPLING_PX = 3.81
OBSCURATION = 0.49
ACROSS = 48  # samples across the pupil
SUB_EXPOSURES = 3


def speckle_cube(
    frames: int = 60,
    size: int = 64,
    *,
    flux_e: float = 1e7,
    residual_rad: float = 0.5,
    memory: float = 0.7,
    read_noise_e: float = 15.0,
    stripes_e: float = 0.0,
    seed: int = 0,
) -> np.ndarray:
    """Return frames (frames, size, size) [e-] of a star with `flux_e` electrons inside the window.

    `residual_rad` is the RMS of the residual phase within a frame, half of its variance static, `memory` the
    correlation of the changing phase from one exposure to the next, and `stripes_e` the RMS of an offset that
    all pixels of a row share in one frame.
    """
    rng = np.random.default_rng(seed)
    static = _screen(rng) * residual_rad / np.sqrt(2)
    moving = _screen(rng)
    images = np.zeros((frames, size, size))
    for image in images:
        for _ in range(SUB_EXPOSURES):
            moving = memory * moving + np.sqrt(1 - memory**2) * _screen(rng)
            image += _intensity(static + moving * residual_rad / np.sqrt(2), size)
    images *= flux_e / images.sum(axis=(1, 2)).mean()
    stripes = rng.normal(0, stripes_e, (frames, size, 1))
    return rng.poisson(images) + rng.normal(0, read_noise_e, images.shape) + stripes


def _pupil() -> np.ndarray:
    y, x = (np.indices((ACROSS, ACROSS)) - (ACROSS - 1) / 2) / ACROSS
    radius = np.hypot(y, x)
    return ((radius <= 0.5) & (radius >= 0.5 * OBSCURATION)).astype(float)


def _screen(rng: np.random.Generator) -> np.ndarray:
    """Phase of unit RMS over the pupil with a power spectrum that falls like f^-2."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(2 * ACROSS), np.fft.fftfreq(2 * ACROSS)))
    frequency[0, 0] = np.inf
    white = np.fft.fft2(rng.normal(size=frequency.shape))
    phase = np.fft.ifft2(white / frequency).real[:ACROSS, :ACROSS]
    inside = _pupil() > 0
    phase -= phase[inside].mean()
    return phase / phase[inside].std()


def _intensity(phase: np.ndarray, size: int) -> np.ndarray:
    across = (np.arange(ACROSS) - (ACROSS - 1) / 2) / ACROSS
    transform = np.exp(-2j * np.pi * np.outer(np.arange(size) - (size - 1) / 2, across) / SAMPLING_PX)
    return np.abs(transform @ (_pupil() * np.exp(1j * phase)) @ transform.T) ** 2
