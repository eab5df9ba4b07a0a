"""Shifts of well-sampled images by band-limited interpolation, as matrices along one axis.

An image without frequencies beyond f (cycles per pixel, f < ½) is interpolated exactly by any kernel whose
spectrum is one up to f and zero from 1 - f on, where the replicas of the sampled image begin. The gentler the
way down between the two, the faster the kernel falls off. Here it is a Kaiser-windowed sinc with the ripples
of its spectrum ironed out, given by its cosine series; the derivative of a shift is exact.

Reference: Kaiser & Schafer 1980, IEEE Trans. ASSP 28, 105 (length and attenuation of the window).
"""

from __future__ import annotations

import numpy as np
import torch

ATTENUATION_DB = 100.0  # of what the kernel has left beyond its half length
WELL_SAMPLED = 0.4  # highest frequency [cycles/px] of images that short kernels can shift


def kernel_half_length(band: float) -> int:
    """Pixels on either side that a kernel needs for images without frequencies beyond `band` [1/px]."""
    return int(np.ceil((ATTENUATION_DB - 7.95) / (14.36 * (1 - 2 * band)) / 2))


class ShiftMatrices:
    """Matrices from samples of an image, in reversed order, to pixels of the shifted image.

    Parameters
    ----------
    pixels : int
        In the window.
    beyond : int
        Further samples on each side.
    band : float
        Highest frequency of the images [cycles/px].
    like : tensor
        Of the precision and on the device that the matrices are to have.
    """

    def __init__(self, pixels: int, beyond: int, band: float, like: torch.Tensor):
        self.samples = pixels + 2 * beyond
        frequency = np.arange(int((1 - band) * self.samples) + 1) / self.samples
        rate = 2 * np.pi * frequency
        phase = np.outer(rate, np.arange(-(pixels + beyond - 1), pixels + beyond))
        cosine, sine = _spectrum(frequency, band)[:, None] * (np.cos(phase), np.sin(phase))
        slopes = np.concatenate([rate[:, None] * sine, -rate[:, None] * cosine])
        series = np.concatenate([np.concatenate([cosine, sine]), slopes], axis=1)
        self.rate = torch.as_tensor(rate, device=like.device)
        self.series = torch.as_tensor(series).to(like)

    def __call__(self, shift_px: torch.Tensor) -> torch.Tensor:
        """Matrices and their derivatives with respect to the shift, (images, 2, pixels, samples).

        Parameters
        ----------
        shift_px : tensor, (images,), float64
            Positive towards larger indices.
        """
        phase = shift_px[:, None] * self.rate
        kernels = torch.cat([phase.cos(), phase.sin()], dim=1).to(self.series.dtype) @ self.series
        return kernels.unflatten(1, (2, -1)).unfold(2, self.samples, 1)


def _spectrum(frequency: np.ndarray, band: float) -> np.ndarray:
    """Weights of the cosine series of the kernel, whose period is that of the first frequency."""
    length = kernel_half_length(band)
    x = np.linspace(-length, length, 16 * length + 1)
    beta = 0.1102 * (ATTENUATION_DB - 8.7)
    kernel = np.sinc(x) * np.kaiser(len(x), beta)
    smooth = np.cos(2 * np.pi * np.outer(frequency, x)) @ kernel * (x[1] - x[0])
    exact = np.where(frequency <= band, 1.0, np.where(frequency >= 1 - band, 0.0, smooth))
    counts = np.where(frequency > 0, 2.0, 1.0)
    return counts * exact * frequency[1]
