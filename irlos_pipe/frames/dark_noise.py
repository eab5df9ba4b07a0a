"""How noisy the dark image was that is taken from every frame, seen in the mean of the frames.

The noise of a dark is the same in all frames and does not average out. A single dark image cannot tell
it from the detector's own pattern, which is taken out with it and does no harm; the mean of the frames
can: what the dark left there varies from pixel to pixel, faster than the image of any star, which ends
at the cut-off of the telescope, D/λ.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import convolve1d

from irlos_pipe.frames.blocks import frame_variance, mean_frame

FINE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])  # along both axes: leaves what is finer than 3 pixels
FAINT = 0.25  # part of the window, the faintest, where the star's own structure is least
CHI2_MEDIAN = 0.4549  # of one degree of freedom


def dark_variance_e2(images_e: np.ndarray, pixel_mask: np.ndarray, at_most_e2: float) -> float:
    """Variance per pixel of the dark image, from the frames that it was taken from.

    Parameters
    ----------
    images_e : ndarray, (frames, rows, columns)
        Signal above the dark [e-].
    pixel_mask : ndarray of bool, (rows, columns)
        True for good pixels.
    at_most_e2 : float
        Variance of the dark as judged from the dark itself, the detector's pattern included [e-²]; infinite
        if none was taken.

    Returns
    -------
    float
        Variance of the mean frame from pixel to pixel beyond the scatter between frames [e-²]; a star that
        is sharper than the pixels can show raises it, up to `at_most_e2`. Where frames cannot tell, that, or
        0 if it is infinite.
    """
    unknown_e2 = at_most_e2 if np.isfinite(at_most_e2) else 0.0
    if at_most_e2 == 0 or len(images_e) < 2 or min(pixel_mask.shape) < 2 * len(FINE):
        return unknown_e2
    mean_e = mean_frame(images_e)
    scatter_e2 = frame_variance(images_e, mean_e) / len(images_e)
    mean_e = np.where(pixel_mask, mean_e, np.nan)
    fine, by_scatter = _both_ways(mean_e, FINE) ** 2, _both_ways(scatter_e2, FINE**2)
    seen = np.isfinite(fine) & (mean_e <= np.nanquantile(mean_e, FAINT))
    if not seen.any():
        return unknown_e2
    beyond = np.median(fine[seen]) / CHI2_MEDIAN - np.median(by_scatter[seen])
    return float(np.clip(beyond / np.sum(FINE**2) ** 2, 0.0, at_most_e2))


def _both_ways(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Convolution along rows and columns; NaN near edges and bad pixels."""
    for axis in (0, 1):
        image = convolve1d(image, kernel, axis=axis, mode="constant", cval=np.nan)
    return image
