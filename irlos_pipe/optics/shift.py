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


def kernel_half_length(band: float) -> int:
    """Pixels on either side that a kernel needs for images without frequencies beyond `band` [1/px]."""
    return int(np.ceil((ATTENUATION_DB - 7.95) / (14.36 * (1 - 2 * band)) / 2))


class ShiftMatrices:
    """Matrices from samples of an image, reversed along both axes, to rows and columns of the shifted window.

    Parameters
    ----------
    window : (int, int)
        Rows and columns [px].
    beyond : int
        Further samples on each side of the window.
    band : float
        Highest frequency of the images [cycles/px].
    per_px : float
        Units of a shift that make a pixel.
    like : tensor
        Of the precision and on the device that the matrices are to have.
    """

    def __init__(self, window: tuple[int, int], beyond: int, band: float, per_px: float, like: torch.Tensor):
        self.window, self.beyond = window, beyond
        period = max(window) + 2 * beyond
        frequency = np.arange(int((1 - band) * period) + 1) / period
        rate = 2 * np.pi * frequency
        phase = np.outer(rate, np.arange(1 - max(window) - beyond, max(window) + beyond))
        cosine, sine = _spectrum(frequency, band)[:, None] * (np.cos(phase), np.sin(phase))
        slopes = np.concatenate([rate[:, None] * sine, -rate[:, None] * cosine]) / per_px
        series = np.concatenate([np.concatenate([cosine, sine]), slopes], axis=1)
        self.rate = torch.as_tensor(rate / per_px, device=like.device)
        self.series = torch.as_tensor(series).to(like)

    def __call__(self, shifts: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Matrices for the rows and for the columns, each followed by its derivative.

        Parameters
        ----------
        shifts : tensor, (images, 2), float64
            Along x and y, positive towards larger indices.

        Returns
        -------
        rows, columns : tensor, (images, 2 pixels, samples)
        """
        phase = shifts[..., None] * self.rate
        kernels = torch.cat([phase.cos(), phase.sin()], dim=2).to(self.series.dtype) @ self.series
        along_x, along_y = kernels.unflatten(2, (2, -1)).unbind(1)
        return self._matrices(along_y, self.window[0]), self._matrices(along_x, self.window[1])

    def _matrices(self, kernels: torch.Tensor, pixels: int) -> torch.Tensor:
        """Toeplitz matrices of kernels (images, 2, values) that reach over the longer side of the window."""
        own = kernels[:, :, max(self.window) - pixels :]
        return own.unfold(2, pixels + 2 * self.beyond, 1)[:, :, :pixels].flatten(1, 2)


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
