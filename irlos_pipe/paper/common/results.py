"""Parts of the results that several experiments share."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import stats

from irlos_pipe.product.results import Number, ResultsPart

DRAWS, BOOTSTRAP_SEED = 4000, 0
TAIL = 0.05  # beyond each end of a range of 90 %
ONE_SIGMA = (15.87, 50.0, 84.13)  # percentiles of a normal distribution at -1σ, 0 and +1σ


class Percentiles(ResultsPart):
    """Median and one-sigma range of some values."""

    median: Number = math.nan
    p16: Number = math.nan
    p84: Number = math.nan

    @classmethod
    def of(cls, values: Sequence[float] | np.ndarray, ranks: Sequence[float] = ONE_SIGMA) -> Percentiles:
        """Return the percentiles of `values` at `ranks` [%]."""
        p16, median, p84 = map(float, np.percentile(values, ranks))
        return cls(median=median, p16=p16, p84=p84)


class Interval(ResultsPart):
    """A number from some samples, and the range in which it lies, 90 %, by bootstrap over the samples."""

    value: Number = math.nan
    low: Number = math.nan
    high: Number = math.nan

    @classmethod
    def of_rms(cls, values: Sequence[float] | np.ndarray) -> Interval:
        """Return the root of the mean square of one value per sample, (samples,)."""
        squares = np.square(np.asarray(values, float))
        low, high = np.sqrt(_range(_redrawn(squares).mean(axis=1), len(squares)))
        return cls(value=float(np.sqrt(squares.mean())), low=float(low), high=float(high))

    @classmethod
    def of_median(cls, values: Sequence[float] | np.ndarray) -> Interval:
        """Return the median of one value per sample, (samples,)."""
        found = np.asarray(values, float)
        low, high = _range(np.median(_redrawn(found), axis=1), len(found))
        return cls(value=float(np.median(found)), low=float(low), high=float(high))


def _range(redrawn: np.ndarray, samples: int) -> np.ndarray:
    """Return the range of 90 % from the numbers of redrawn samples, wider where there are few samples.

    Percentiles alone are too narrow then. These are the expanded ones of Hesterberg 2015, Am. Stat. 69, 371;
    of three samples they are nearly the smallest and the largest, which hold the truth in some 75 % only.
    """
    if samples < 2:
        return np.array([np.nan, np.nan])
    reach = np.sqrt(samples / (samples - 1)) * stats.t.isf(TAIL, samples - 1)
    return np.quantile(redrawn, stats.norm.cdf([-reach, reach]))


def _redrawn(values: np.ndarray) -> np.ndarray:
    """Return samples drawn from these with replacement, (DRAWS, samples)."""
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    return values[rng.integers(len(values), size=(DRAWS, len(values)))]
