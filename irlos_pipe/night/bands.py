"""A number, the band in which it is expected from the nights before, and the test of a whole wavefront."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import scipy

from irlos_pipe.night.settings import BandSettings

GAUSSIAN_MAD = 1.4826  # standard deviation of Gaussian values over their median absolute deviation (MAD)
MAD_EFFICIENCY = 0.37  # efficiency of the MAD as an estimate of the standard deviation
MEDIAN_VARIANCE = np.pi / 2  # variance of the median of Gaussian values over that of their mean
# Nights that the errors of a number count for: alone, and where many modes show how good their errors are.
ERROR_NIGHTS, POOLED_ERROR_NIGHTS = 5.0, 10.0
FURTHEST_SIGMA = 37.0  # deviation beyond which the probability is below the smallest number


@dataclass(frozen=True)
class Band:
    """The range in which a number is expected, from `nights` earlier nights."""

    centre: float
    half_width: float
    nights: int
    lowest: float = -np.inf  # what the number cannot be below
    freedom: float = np.inf  # degrees of freedom of Student's t, of which `half_width` is a quantile

    @property
    def low(self) -> float:
        return max(self.centre - self.half_width, self.lowest)

    @property
    def high(self) -> float:
        return self.centre + self.half_width

    def holds(self, value: float) -> bool:
        return self.low <= value <= self.high


@dataclass(frozen=True)
class Point:
    """One number of one run: a row of the table that all texts, pages and plots are made from."""

    run: str
    night: str
    unix_s: float  # start of the recording [s since 1970]; the middle of the night where it is not known
    name: str
    recipe: str
    configuration: str
    value: float
    sigma: float | None  # standard error
    band: Band | None = None  # from the nights before; None where these are too few
    alarm: str = ""  # what is said of it where it is not as expected; else empty


@dataclass(frozen=True)
class History:
    """A number before some night: one value per earlier night."""

    # (nights,): medians over the night of values and of their standard errors; NaN where there is no error.
    medians: np.ndarray
    errors: np.ndarray

    @property
    def centre(self) -> float:
        return float(np.median(self.medians))

    @property
    def error(self) -> float:
        """Typical standard error; NaN where fewer than half of the nights have one."""
        known = np.isfinite(self.errors)
        return float(np.median(self.errors[known])) if 2 * known.sum() > len(known) else np.nan


def histories(points: Sequence[Point], most: int) -> dict[str, History]:
    """Return what is known of a number before each night, of `points` in order of time.

    The `most` latest earlier nights count.
    """
    by_night: dict[str, list[tuple[float, float]]] = {}
    for one in points:
        by_night.setdefault(one.night, []).append((one.value, np.nan if one.sigma is None else one.sigma))
    table = np.array([np.median(np.array(one), axis=0) for one in by_night.values()]).reshape(-1, 2)
    return {night: History(*table[max(0, index - most) : index].T) for index, night in enumerate(by_night)}


def excess_scatter(modes: Sequence[History]) -> float:
    """Return by how much many modes scatter from night to night beyond their errors, at least 1.

    The mean square over the modes of (value − median)/error is taken for every night, and the median over
    the nights of that: one bad night does not count. Deviations from the median of n nights are smaller by
    √(1 − 1/n). All `modes` are of the same nights.
    """
    known = [one for one in modes if np.all(np.isfinite(one.errors)) and np.all(one.errors > 0)]
    if not known or len(known[0].medians) < 2:
        return 1.0
    scores = np.array([(one.medians - one.centre) / one.error for one in known])
    count = scores.shape[1]
    return float(max(1.0, np.sqrt(np.median(np.mean(scores**2, axis=0)) * count / (count - 1))))


def band_of(
    history: History,
    sigma: float | None,
    rule: BandSettings,
    excess: float | None = None,
    lowest: float = -np.inf,
) -> Band | None:
    """Return the band of a value, or None where too few nights are known.

    Centre c and scatter s are median and scaled median absolute deviation (MAD) of one value per night, so
    that one bad night hardly moves them; from n nights s has ν = 0.37 (n − 1) degrees of freedom. Where the
    values have errors ε, the scatter is not all that is known: s² is the mean of s² and (kε)² with the
    weights ν and ν₀, and has ν + ν₀ degrees of freedom. ν₀ is 10 where k, the scatter over the errors, is
    measured on many modes, and 5 with k = 1 otherwise. The half width is that of a prediction interval,
    ``t(1 − p/2; ν + ν₀) √(s² (1 + π/2n) + max(σ² − ε², 0))`` with the value's own error σ.

    The `history` is that before the night; the `rule` has the probability p of a false alarm, and how many
    nights it takes; `excess` is k, see `excess_scatter`; the number cannot be below `lowest`.
    """
    count, error = len(history.medians), history.error
    if count < (rule.least_nights_with_errors if np.isfinite(error) else rule.least_nights):
        return None
    scatter = GAUSSIAN_MAD * float(np.median(np.abs(history.medians - history.centre)))
    own, of_errors = MAD_EFFICIENCY * (count - 1), 0.0
    if np.isfinite(error):
        of_errors = ERROR_NIGHTS if excess is None else POOLED_ERROR_NIGHTS
        expected = error * (excess or 1.0)
        scatter = np.sqrt((own * scatter**2 + of_errors * expected**2) / (own + of_errors))
    beyond = (sigma or 0.0) ** 2 - (error**2 if np.isfinite(error) else 0.0)
    width = np.sqrt(scatter**2 * (1 + MEDIAN_VARIANCE / count) + max(beyond, 0.0))
    half = _quantile(rule.false_alarm, own + of_errors) * float(width)
    return Band(history.centre, half, count, lowest, own + of_errors)


@cache
def _quantile(false_alarm: float, freedom: float) -> float:
    """Half width of the band in standard deviations."""
    return -float(scipy.special.stdtrit(freedom, false_alarm / 2))


@dataclass(frozen=True)
class WavefrontTest:
    """All modes of a run against the nights before it."""

    change_nm: float  # RMS of the differences from the medians [nm]
    # Sum of the squares of the differences in standard deviations, and what it exceeds with the
    # probability of a false alarm.
    chi2: float
    limit: float
    modes: int
    nights: int

    @property
    def holds(self) -> bool:
        return self.chi2 <= self.limit

    def __str__(self) -> str:
        return (
            f"{self.change_nm:.3g} nm RMS from the median of {self.nights} nights, "
            f"χ² {self.chi2:.3g} of {self.modes} (limit {self.limit:.3g})"
        )


def wavefront_test(values: Sequence[float], found: Sequence[Band], rule: BandSettings) -> WavefrontTest:
    """Test all modes of a run together: `values` [nm] against the bands `found` for them.

    A change that no single mode shows is seen in the sum of squares: every difference is taken to the
    Gaussian deviation of the same probability, so that the sum follows χ² also where the scatter is known
    from few nights. The `rule` has the probability of a false alarm.
    """
    differences = np.array([value - band.centre for value, band in zip(values, found, strict=True)])
    unit = np.array([band.half_width / _quantile(rule.false_alarm, band.freedom) for band in found])
    freedom = np.array([band.freedom for band in found])
    tail = scipy.special.stdtr(freedom, -np.abs(differences) / np.maximum(unit, np.finfo(float).tiny))
    scores = np.minimum(-scipy.special.ndtri(tail), FURTHEST_SIGMA)
    return WavefrontTest(
        float(np.sqrt(np.sum(differences**2))),
        float(np.sum(scores**2)),
        float(scipy.special.chdtri(len(found), rule.false_alarm)),
        len(found),
        min(band.nights for band in found),
    )
