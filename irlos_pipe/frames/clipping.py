"""Pixels that stop at a level of their own: full wells and converters at their end, whatever the level is.

A detector whose pixels respond unequally, and whose frames were divided by a flat or recentred, has no common
level of saturation. A clipped pixel shows by the company of its values: they lie together much closer than
the noise of the photons would let them.
"""

from __future__ import annotations

import numpy as np
import scipy

from irlos_pipe.frames.noise import MIN_FRAMES_FOR_NOISE

BRIGHT = 0.5  # of the peak: what is fainter than that is not clipped while the peak grows
FALSE_ALARM = 1e-6  # chance that the values of a good pixel lie together as close
WIDTHS = ((0.1, 1.0), (0.5, 4.0))  # in sigma: how close values are, among those how far around


def clipped_samples(images: np.ndarray, good: np.ndarray, sigma: np.ndarray, step: float) -> np.ndarray:
    """Find values of bright pixels that recur from frame to frame more closely than noise permits.

    For every value the number of others within a fraction of the noise is compared with the number in a
    wider surrounding; normal noise alone, or any wider distribution, keeps the first to a known share.

    Parameters
    ----------
    images : ndarray, (frames, rows, columns)
        Finite, on any linear scale.
    good : ndarray of bool, (rows, columns)
        Pixels to search.
    sigma : ndarray, (rows, columns)
        Noise of a value, on the same scale; not more than the true one.
    step : float
        Step of the digitisation on the same scale, 0 if there is none; where it rivals the closeness, equal
        values mean nothing.

    Returns
    -------
    ndarray of bool, (frames, rows, columns)
        All False with fewer than `MIN_FRAMES_FOR_NOISE` frames.
    """
    clipped = np.zeros(images.shape, dtype=bool)
    if len(images) < MIN_FRAMES_FOR_NOISE or not good.any():
        return clipped
    typical = np.where(good, np.median(images, axis=0), -np.inf)
    bright = typical > BRIGHT * typical.max()
    values = images[:, bright].astype(np.float64)
    noise = np.broadcast_to(sigma[bright], values.shape)
    own = np.stack([_piled_up(*one, step) for one in zip(values.T, noise.T, strict=True)], axis=1)
    # a recording that was recentred shows the level of one pixel of the detector in several of its own
    together = _piled_up(values.ravel(), noise.ravel(), step).reshape(values.shape)
    clipped[:, bright] = own | together
    return clipped


def _piled_up(values: np.ndarray, sigma: np.ndarray, step: float) -> np.ndarray:
    found = np.zeros(len(values), dtype=bool)
    for close, wide in WIDTHS:
        near, around = (_others_within(values, width * sigma) for width in (close, wide))
        # of normal values about their own mean; any wider distribution has a smaller share
        share = scipy.special.erf(close / np.sqrt(2)) / scipy.special.erf(wide / np.sqrt(2))
        by_chance = scipy.special.bdtrc(near - 1, around, share)  # that as many or more are near
        found |= (by_chance < FALSE_ALARM) & (close * sigma > 2 * step)
    return found


def _others_within(values: np.ndarray, distance: np.ndarray) -> np.ndarray:
    ordered = np.sort(values)
    below = np.searchsorted(ordered, values - distance, side="left")
    above = np.searchsorted(ordered, values + distance, side="right")
    return above - below - 1
