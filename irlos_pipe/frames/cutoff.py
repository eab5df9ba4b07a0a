"""The highest spatial frequency of an image, which telescope, wavelength and pixel scale set to D/λ."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

RINGS_PER_PX = 2.0  # rings of the spectrum per sample: half a sample wide
BEYOND = 1.25  # times the expected cut-off, from where on there is nothing but noise
ABOVE_NOISE = 3.0  # ring means that count as signal, over those of the noise
LOBE = 2.0  # half of the width of the main lobe of the taper (Hann), in samples of the spectrum
LEAST_SNR = 1e3  # amplitude at zero frequency over noise: of a fainter image the end is not seen


def cutoff_ratio(mean_e: np.ndarray, good: np.ndarray, expected_per_px: float) -> float:
    """Return the highest spatial frequency with signal over the expected cut-off.

    The noise level is that of the highest frequencies of the image itself, so that hot pixels and an unequal
    response, whose spectrum is flat, do not count as signal.

    Parameters
    ----------
    mean_e : ndarray, (rows, columns)
        Mean image.
    good : ndarray of bool, (rows, columns)
    expected_per_px : float
        D/λ [cycles per pixel].

    Returns
    -------
    float
        NaN where nothing lies beyond the cut-off, or the image is too faint to tell.
    """
    if BEYOND * expected_per_px > 0.45 or min(mean_e.shape) < 16:
        return float("nan")
    filled = np.where(good, mean_e, median_filter(mean_e, 5))
    taper = np.outer(*(np.hanning(side + 2)[1:-1] for side in mean_e.shape))
    power = np.abs(np.fft.rfft2(filled * taper)) ** 2
    rows, columns = mean_e.shape
    frequency = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(columns)[None, :])
    width = 1 / (RINGS_PER_PX * max(rows, columns))
    ring = np.round(frequency / width).astype(int)
    count = np.bincount(ring.ravel())
    rings = np.bincount(ring.ravel(), power.ravel()) / np.maximum(count, 1)
    noise = float(np.median(power[(frequency > BEYOND * expected_per_px) & (frequency < 0.5)])) / np.log(2)
    if not np.sqrt(power[0, 0]) > LEAST_SNR * np.sqrt(noise) > 0:
        return float("nan")
    inside = (count > 0) & (np.arange(len(rings)) * width < 0.5)
    end = float(np.flatnonzero(inside & (rings > ABOVE_NOISE * noise))[-1]) * width
    if end > expected_per_px:  # the taper smears the spectrum by half of its main lobe
        end = max(expected_per_px, end - LOBE / min(mean_e.shape))
    return end / expected_per_px
