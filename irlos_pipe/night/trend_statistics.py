"""Statistics of series in time: the band in which a number is expected, and the structure function."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import scipy

from irlos_pipe.night.settings import BandSettings

GAUSSIAN_MAD = 1.4826  # standard deviation of Gaussian values over their median absolute deviation (MAD)
MAD_EFFICIENCY = 0.37  # of the MAD as an estimator of the standard deviation, relative to the sample's own
MEDIAN_VARIANCE = np.pi / 2  # variance of the median of Gaussian values over that of their mean
DAY_S = 86400.0
# Within an hour, within a night, then doubling; the edges lie half a day off whole numbers of nights.
LAG_EDGES_S = np.concatenate([[0.0, 3600.0], DAY_S * (2.0 ** np.arange(13) - 0.5)])


@dataclass(frozen=True)
class Band:
    """The range in which a number is expected, `centre` ± `half_width`, from `nights` earlier nights."""

    centre: float
    half_width: float
    nights: int

    @property
    def low(self) -> float:
        """Lower end."""
        return self.centre - self.half_width

    @property
    def high(self) -> float:
        """Upper end."""
        return self.centre + self.half_width

    def holds(self, value: float) -> bool:
        """Whether a value lies within the band."""
        return self.low <= value <= self.high


def bands(
    nights: Sequence[str], values: Sequence[float], sigmas: Sequence[float | None], rule: BandSettings
) -> list[Band | None]:
    """Return the band of every value, from the nights before its own.

    Centre c and scatter s are median and scaled median absolute deviation (MAD) of one value per night (its
    median), so that one bad night hardly moves them. From n nights alone the scatter is itself uncertain. The
    half width is therefore that of a prediction interval,
    ``w √(s² (1 + π/2n) + σ²)`` with ``w = t(1 − p/2; 0.37 (n − 1))``: Student's t with the degrees of freedom
    reduced by the efficiency of the MAD keeps the probability p of a false alarm; σ is the value's own error.

    Parameters
    ----------
    nights : sequence of str
        ISO dates in ascending order.
    values, sigmas : sequence of float, sequence of float or None
        The numbers and their standard errors.
    rule : BandSettings
        Probability p and number of nights n.

    Returns
    -------
    list of Band or None
        None for values with too few nights before them.
    """
    by_night: dict[str, list[float]] = {}
    for night, value in zip(nights, values, strict=True):
        by_night.setdefault(night, []).append(value)
    medians = np.array([np.median(one) for one in by_night.values()])
    before = {
        night: _expected(medians[max(0, index - rule.nights) : index], rule)
        for index, night in enumerate(by_night)
    }
    return [_widened(before[night], sigma) for night, sigma in zip(nights, sigmas, strict=True)]


def _expected(earlier: np.ndarray, rule: BandSettings) -> tuple[Band, float] | None:
    """Band of a value without error, and its half width in standard deviations."""
    count = len(earlier)
    if count < rule.least_nights:
        return None
    centre = float(np.median(earlier))
    scatter = GAUSSIAN_MAD * float(np.median(np.abs(earlier - centre)))
    width = _width(rule.false_alarm, count)
    return Band(centre, width * scatter * float(np.sqrt(1 + MEDIAN_VARIANCE / count)), count), width


@cache
def _width(false_alarm: float, count: int) -> float:
    """Half width of the band in units of the scatter that `count` values show."""
    return -float(scipy.special.stdtrit(MAD_EFFICIENCY * (count - 1), false_alarm / 2))


def _widened(expected: tuple[Band, float] | None, sigma: float | None) -> Band | None:
    if expected is None:
        return None
    band, width = expected
    return replace(band, half_width=float(np.hypot(band.half_width, width * (sigma or 0.0))))


@dataclass(frozen=True)
class Structure:
    """Structure function in bins of the lag; all arrays have shape (bins,), empty bins are left out.

    Attributes
    ----------
    lag_s : ndarray
        Mean lag of the pairs [s].
    change_nm2 : ndarray
        Mean square change of the wavefront after the noise is subtracted; may be negative [nm²].
    noise_nm2 : ndarray
        The noise that was subtracted [nm²].
    pairs : ndarray of int
        Number of pairs.
    """

    lag_s: np.ndarray
    change_nm2: np.ndarray
    noise_nm2: np.ndarray
    pairs: np.ndarray

    @property
    def change_nm(self) -> np.ndarray:
        """RMS change [nm], 0 where the noise explains the change."""
        return np.sqrt(np.maximum(self.change_nm2, 0.0))


def structure_function(
    unix_s: np.ndarray, modes_nm: np.ndarray, sigma_nm: np.ndarray, edges_s: np.ndarray = LAG_EDGES_S
) -> Structure:
    """Return the mean square change of a wavefront against the time lag.

    ``D(lag) = mean over pairs of Σ_modes (a(t + lag) − a(t))² − σ²(t) − σ²(t + lag)``: independent noise of
    the measurements adds the same at every lag and is subtracted; what remains is the instability of the
    wavefront. White changes of variance s² per mode give 2 M s², a random walk of variance s² per second
    gives M s² lag, with M modes.

    Parameters
    ----------
    unix_s : ndarray, (points,)
        Times [s] in ascending order.
    modes_nm, sigma_nm : ndarray, (points, modes)
        Coefficients and their standard errors [nm RMS].
    edges_s : ndarray, (bins + 1,)
        Edges of the bins [s]; pairs beyond the last are left out.
    """
    bins = len(edges_s) - 1
    pairs, lag, change, noise = (np.zeros(bins) for _ in range(4))
    own_noise = np.sum(sigma_nm**2, axis=1)
    for first in range(len(unix_s) - 1):
        lags = unix_s[first + 1 :] - unix_s[first]
        index = np.searchsorted(edges_s, lags, side="right") - 1
        within = index < bins
        index = index[within]
        square = np.sum((modes_nm[first + 1 :] - modes_nm[first]) ** 2, axis=1)[within]
        expected = (own_noise[first + 1 :] + own_noise[first])[within]
        for total, weights in ((pairs, None), (lag, lags[within]), (change, square), (noise, expected)):
            total += np.bincount(index, weights, bins)
    filled = pairs > 0
    lag, change, noise = (total[filled] / pairs[filled] for total in (lag, change, noise))
    return Structure(lag, change - noise, noise, pairs[filled].astype(int))
