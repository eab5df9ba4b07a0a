"""Statistics of series in time: the band a number keeps, and the structure function of the NCPAs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.stats import t as student_t

GAUSSIAN_MAD = 1.4826  # standard deviation of Gaussian values over their median absolute deviation
MAD_EFFICIENCY = 0.37  # of the latter as an estimate of the former, against the sample's own deviation
MEDIAN_VARIANCE = np.pi / 2  # of a median over that of a mean
DAY_S = 86400.0
# Within an hour and a night, then doubling, half a day off whole numbers of nights.
LAG_EDGES_S = np.concatenate([[0.0, 3600.0], DAY_S * (2.0 ** np.arange(13) - 0.5)])


@dataclass(frozen=True)
class Band:
    """Where a number is expected: `centre` ± `half_width`, from so many earlier `nights`."""

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
        """Whether a value lies within."""
        return self.low <= value <= self.high


@dataclass(frozen=True)
class BandRule:
    """How bands are made.

    Attributes
    ----------
    false_alarm : float
        Probability that a value leaves its band though nothing changed (Gaussian scatter).
    most, least : int
        Number of earlier nights to use at most, the latest ones, and below which there is no band.
    """

    false_alarm: float
    most: int
    least: int


def bands(
    nights: Sequence[str], values: Sequence[float], sigmas: Sequence[float | None], rule: BandRule
) -> list[Band | None]:
    """Return the band of every value, from the nights before its own.

    Centre and scatter are median and scaled median absolute deviation of one value per night (its
    median), so that a night that went wrong moves them little. Over few nights the scatter is itself
    uncertain: a prediction interval of Student's t, its degrees of freedom reduced by the efficiency of the
    median absolute deviation, keeps the rate of false alarms. The value's own error widens the band.

    Parameters
    ----------
    nights : sequence of str
        ISO dates, not falling.
    sigmas : sequence of float or None
        1-sigma errors of the values.
    """
    by_night: dict[str, list[float]] = {}
    for night, value in zip(nights, values, strict=True):
        by_night.setdefault(night, []).append(value)
    medians = np.array([np.median(one) for one in by_night.values()])
    before = {
        night: _expected(medians[max(0, place - rule.most) : place], rule)
        for place, night in enumerate(by_night)
    }
    return [_widened(before[night], sigma) for night, sigma in zip(nights, sigmas, strict=True)]


def _expected(earlier: np.ndarray, rule: BandRule) -> tuple[Band, float] | None:
    """Band of a value without error, and its width in standard deviations."""
    count = len(earlier)
    if count < rule.least:
        return None
    centre = float(np.median(earlier))
    scatter = GAUSSIAN_MAD * float(np.median(np.abs(earlier - centre)))
    width = _width(rule.false_alarm, count)
    return Band(centre, width * scatter * float(np.sqrt(1 + MEDIAN_VARIANCE / count)), count), width


@cache
def _width(false_alarm: float, count: int) -> float:
    """Half width of the band in units of the scatter that `count` values show."""
    return float(student_t.isf(false_alarm / 2, MAD_EFFICIENCY * (count - 1)))


def _widened(expected: tuple[Band, float] | None, sigma: float | None) -> Band | None:
    if expected is None:
        return None
    band, width = expected
    return replace(band, half_width=float(np.hypot(band.half_width, width * (sigma or 0.0))))


@dataclass(frozen=True)
class Structure:
    """Structure function in bins of the lag that are not empty, each (bins,).

    Attributes
    ----------
    lag_s : ndarray
        Mean lag of the pairs [s].
    change_nm2 : ndarray
        Mean square change of the wavefront, the noise taken off; may be negative [nm²].
    noise_nm2 : ndarray
        What was taken off [nm²].
    pairs : ndarray of int
    """

    lag_s: np.ndarray
    change_nm2: np.ndarray
    noise_nm2: np.ndarray
    pairs: np.ndarray

    @property
    def change_nm(self) -> np.ndarray:
        """RMS change [nm], 0 where nothing is left above the noise."""
        return np.sqrt(np.maximum(self.change_nm2, 0.0))


def structure_function(
    unix_s: np.ndarray, modes_nm: np.ndarray, sigma_nm: np.ndarray, edges_s: np.ndarray = LAG_EDGES_S
) -> Structure:
    """Return how much a wavefront changes within a lag.

    ``D(lag) = mean over pairs of sum over modes of (a(t + lag) - a(t))² - sigma²(t) - sigma²(t + lag)``:
    independent noise of each measurement adds the same at any lag and is taken off; what remains is the
    instability of the NCPAs. White changes of variance s² per mode give 2 M s², a random walk of step
    variance s² per second M s² lag, with M modes.

    Parameters
    ----------
    unix_s : ndarray, (points,)
        Times [s], not falling.
    modes_nm, sigma_nm : ndarray, (points, modes)
        Coefficients and their errors [nm RMS].
    edges_s : ndarray
        Edges of the bins [s]; pairs beyond the last are left out.
    """
    bins = len(edges_s) - 1
    pairs, lag, change, noise = (np.zeros(bins) for _ in range(4))
    own_noise = np.sum(sigma_nm**2, axis=1)
    for first in range(len(unix_s) - 1):
        lags = unix_s[first + 1 :] - unix_s[first]
        place = np.searchsorted(edges_s, lags, side="right") - 1
        within = place < bins
        place = place[within]
        square = np.sum((modes_nm[first + 1 :] - modes_nm[first]) ** 2, axis=1)[within]
        expected = (own_noise[first + 1 :] + own_noise[first])[within]
        for total, weights in ((pairs, None), (lag, lags[within]), (change, square), (noise, expected)):
            total += np.bincount(place, weights, bins)
    filled = pairs > 0
    lag, change, noise = (total[filled] / pairs[filled] for total in (lag, change, noise))
    return Structure(lag, change - noise, noise, pairs[filled].astype(int))
