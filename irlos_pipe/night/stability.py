"""How long NCPAs stay as they are: the structure function, its confidence interval, a time of validity."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

DAY_S = 86400.0
# Within an hour, within a night, then doubling; the edges lie half a day off whole numbers of nights.
LAG_EDGES_S = np.concatenate([[0.0, 3600.0], DAY_S * (2.0 ** np.arange(13) - 0.5)])
CONFIDENCE = 0.95
TAILS = (50 * (1 - CONFIDENCE), 100 - 50 * (1 - CONFIDENCE))
DRAWS = 200  # series of nights for a confidence interval
MOST_POINTS = 100  # calibrations in the nights that are drawn: more take long and narrow no interval
LEAST_NM2 = 1e-6  # change of calibrations that are the same, as of rounding
MIN_DRAWN_MODES, MAX_DRAWN_MODES = 1, 40  # modes in which nights are drawn to change


@dataclass(frozen=True)
class Structure:
    """Structure function in bins of the lag; all arrays have shape (bins,), empty bins are left out."""

    lag_s: np.ndarray  # mean lag of the pairs [s]
    # Mean square change of the wavefront after the noise is subtracted; may be negative [nm²].
    change_nm2: np.ndarray
    noise_nm2: np.ndarray  # the noise that was subtracted [nm²]
    pairs: np.ndarray
    # low_nm, high_nm: confidence interval of the RMS change [nm], see `with_confidence`; NaN without it.
    low_nm: np.ndarray
    high_nm: np.ndarray

    @property
    def change_nm(self) -> np.ndarray:
        """RMS change [nm], 0 where the noise explains the change."""
        return np.sqrt(np.maximum(self.change_nm2, 0.0))


def structure_function(unix_s: np.ndarray, modes_nm: np.ndarray, sigma_nm: np.ndarray) -> Structure:
    """Return the mean square change of a wavefront against the time lag.

    ``D(lag) = mean over pairs of Σ_modes (a(t + lag) − a(t))² − σ²(t) − σ²(t + lag)``: independent noise of
    the measurements adds the same at every lag and is subtracted; what remains is the instability of the
    wavefront. White changes of variance s² per mode give 2 M s², a random walk of variance s² per second
    gives M s² lag, with M modes.

    Times `unix_s`, (points,), are in ascending order; `modes_nm` and `sigma_nm`, (points, modes), are
    coefficients and their standard errors [nm RMS]. Pairs beyond the last edge of the bins are left out.
    """
    first, second = np.triu_indices(len(unix_s), 1)
    lags = unix_s[second] - unix_s[first]
    index = np.searchsorted(LAG_EDGES_S, lags, side="right") - 1
    within = index < len(LAG_EDGES_S) - 1
    first, second, lags, index = first[within], second[within], lags[within], index[within]
    own_noise = np.sum(sigma_nm**2, axis=1)
    pairs = np.bincount(index)
    filled = pairs > 0
    lag, square, noise = (
        np.bincount(index, weights)[filled] / pairs[filled]
        for weights in (lags, _square_changes(modes_nm)[first, second], own_noise[first] + own_noise[second])
    )
    change, pairs = square - noise, pairs[filled]
    unknown = np.full(len(lag), np.nan)
    return Structure(lag, change, noise, pairs, unknown, unknown)


def _square_changes(modes_nm: np.ndarray) -> np.ndarray:
    """Sum over the modes of (a(t) − a(t'))², (points, points) [nm²]."""
    centred = modes_nm - modes_nm.mean(axis=0)
    products = centred @ centred.T
    own = np.diagonal(products)
    return np.maximum(own[:, None] + own - 2 * products, 0.0)


@dataclass(frozen=True)
class Drift:
    """A wavefront that changes from one calibration to the next: D(lag) = white + rate · lag."""

    white_nm2: float  # mean square change that does not depend on the lag [nm²]
    rate_nm2_per_day: float  # growth of the mean square change [nm²/day], as of a random walk

    def change_nm2(self, lag_s: np.ndarray) -> np.ndarray:
        """Return the mean square change after `lag_s` [nm²]."""
        return self.white_nm2 + self.rate_nm2_per_day * lag_s / DAY_S

    def reaches_days(self, change_nm: float) -> float:
        """Return after how many days the RMS change is `change_nm`; infinite without a drift."""
        if self.white_nm2 >= change_nm**2:
            return 0.0
        if self.rate_nm2_per_day <= 0:
            return float("inf")
        return float((change_nm**2 - self.white_nm2) / self.rate_nm2_per_day)


@dataclass(frozen=True)
class Validity:
    """How long the NCPAs stay within some RMS change."""

    change_nm: float
    # days, low_days, high_days: the time, and its confidence interval; infinite where no drift is seen.
    days: float
    low_days: float
    high_days: float
    seen_days: float  # the longest lag between two calibrations


def fitted_drift(found: Structure) -> Drift:
    """Fit the model of a drift to a structure function, with weights by the number of pairs."""
    weight = np.sqrt(found.pairs) / np.maximum(found.change_nm2 + found.noise_nm2, LEAST_NM2)
    design = np.stack([np.ones(len(found.lag_s)), found.lag_s / DAY_S], axis=1) * weight[:, None]
    white, rate = _not_negative(design, np.maximum(found.change_nm2, 0.0) * weight)
    return Drift(white, rate)


def _not_negative(design: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    """Least squares of two parameters, neither below zero: if one would be, the other alone."""
    both = np.linalg.lstsq(design, target, rcond=None)[0]
    if len(target) > 1 and np.all(both >= 0):
        return float(both[0]), float(both[1])
    power = np.sum(design**2, axis=0)  # none where all calibrations are of one time
    alone = np.maximum(np.divide(design.T @ target, power, out=np.zeros(2), where=power > 0), 0.0)
    missed = np.sum((target[:, None] - design * alone) ** 2, axis=0)
    return (float(alone[0]), 0.0) if missed[0] <= missed[1] else (0.0, float(alone[1]))


def with_confidence(
    found: Structure, unix_s: np.ndarray, modes_nm: np.ndarray, sigma_nm: np.ndarray, change_nm: float
) -> tuple[Structure, Validity]:
    """Add confidence intervals to a structure function, and say how long the wavefront stays as it is.

    Neighbouring pairs share calibrations, so that the scatter of the pairs says little. Instead nights are
    drawn that drift as these do: white changes and a random walk of the fitted sizes, at the same times, with
    the errors of the measurement, in as many modes as have a share in the changes. What the same statistics
    make of them, relative to the truth, bounds the truth behind what was measured.

    The arrays are those of `structure_function`; a calibration is valid until an RMS change of `change_nm`.
    """
    drift = fitted_drift(found)
    drawn = list(_drawn(drift, unix_s, modes_nm, sigma_nm))
    ratios = [_ratio_by_bin(one, drift, found) for one in drawn]
    smallest, largest = np.nanpercentile(np.array(ratios), TAILS, axis=0)
    total = found.change_nm2 + found.noise_nm2
    low, high = (np.sqrt(np.maximum(total / one - found.noise_nm2, 0.0)) for one in (largest, smallest))
    bounded = replace(found, low_nm=low, high_nm=high)
    return bounded, _validity(bounded, drift, [fitted_drift(one) for one in drawn], change_nm)


def _drawn(
    drift: Drift, unix_s: np.ndarray, modes_nm: np.ndarray, sigma_nm: np.ndarray
) -> Iterator[Structure]:
    """Structure functions of nights that drift like these."""
    chosen = np.unique(np.linspace(0, len(unix_s) - 1, min(len(unix_s), MOST_POINTS)).round().astype(int))
    times, modes = unix_s[chosen], _effective_modes(modes_nm)
    noise = np.sqrt(np.sum(sigma_nm[chosen] ** 2, axis=1) / modes)[:, None]
    steps = np.sqrt(drift.rate_nm2_per_day / modes * np.diff(times, prepend=times[0]) / DAY_S)[:, None]
    white = np.sqrt(drift.white_nm2 / 2 / modes)
    rng = np.random.default_rng(0)
    for _ in range(DRAWS):
        walk, own, read = rng.normal(size=(3, len(times), modes))
        values = np.cumsum(walk * steps, axis=0) + white * own + noise * read
        yield structure_function(times, values, np.broadcast_to(noise, values.shape))


def _effective_modes(modes_nm: np.ndarray) -> int:
    """Number of modes of equal power that would scatter as these do together."""
    power = np.sum(np.diff(modes_nm, axis=0) ** 2, axis=0)
    count = np.sum(power) ** 2 / np.sum(power**2) if np.any(power > 0) else 1
    return int(np.clip(round(float(count)), MIN_DRAWN_MODES, MAX_DRAWN_MODES))


def _ratio_by_bin(one: Structure, drift: Drift, found: Structure) -> np.ndarray:
    """Drawn over expected change, noise included, in the bins of `found`; NaN where nothing was drawn."""
    edges = np.searchsorted(LAG_EDGES_S, found.lag_s, side="right")
    own = np.searchsorted(LAG_EDGES_S, one.lag_s, side="right")
    total = one.change_nm2 + one.noise_nm2
    expected = drift.change_nm2(one.lag_s) + one.noise_nm2
    ratio = dict(
        zip(own.tolist(), (total / np.maximum(expected, np.finfo(float).tiny)).tolist(), strict=True)
    )
    return np.array([ratio.get(edge, np.nan) for edge in edges.tolist()])


def _validity(found: Structure, drift: Drift, drawn: list[Drift], change_nm: float) -> Validity:
    """The time until the change is reached, with the interval that the drawn nights give.

    As for the bins, their ratio to the truth bounds it; where some of them show no drift at all, their own
    times do.
    """
    days, seen = drift.reaches_days(change_nm), float(found.lag_s.max() / DAY_S)
    others = np.array([one.reaches_days(change_nm) for one in drawn])
    short, long = np.percentile(others, TAILS, method="nearest")
    low, high = short, long
    if short > 0 and 0 < days < np.inf and np.isfinite(long):
        low, high = days**2 / long, days**2 / short
    return Validity(change_nm, days, float(min(low, days)), float(max(high, days)), seen)
