"""The structure function and the time of validity.

Truth: brute force over all pairs, and the analytic structure functions of white noise (2 M s²) and of a
random walk (M s² lag).
"""

from itertools import combinations

import numpy as np
import pytest

from irlos_pipe.night.stability import DAY_S, LAG_EDGES_S, structure_function, with_confidence


def test_every_pair_is_counted_once_in_the_bin_of_its_lag():
    rng = np.random.default_rng(0)
    times = np.sort(rng.uniform(0, 9 * DAY_S, 12))
    modes, sigma = rng.normal(0, 5, (12, 3)), rng.uniform(0.1, 1, (12, 3))
    found = structure_function(times, modes, sigma)
    lags, changes, noises = [], [], []
    for i, j in combinations(range(12), 2):
        lags.append(times[j] - times[i])
        noises.append(np.sum(sigma[i] ** 2 + sigma[j] ** 2))
        changes.append(np.sum((modes[j] - modes[i]) ** 2) - noises[-1])
    bins = np.digitize(lags, LAG_EDGES_S)
    for row, number in enumerate(np.unique(bins)):
        within = bins == number
        assert found.pairs[row] == within.sum()
        for name, values in (("lag_s", lags), ("change_nm2", changes), ("noise_nm2", noises)):
            assert getattr(found, name)[row] == pytest.approx(np.mean(np.array(values)[within]), rel=1e-12)


def test_changes_that_noise_explains_count_as_none():
    values = np.random.default_rng(4).normal(0, 1, (50, 5))
    found = structure_function(DAY_S * np.arange(50), values, np.full((50, 5), 1.2))
    assert np.all(found.change_nm2 < 0) and np.all(found.change_nm == 0)


def drifting(rng, nights: int, modes: int, white_nm2: float, rate: float, noise_nm: float):
    """Times, values and errors of nights that drift as a random walk of `rate` nm² per day in all modes."""
    walk = np.cumsum(rng.normal(0, np.sqrt(rate / modes), (nights, modes)), axis=0)
    own = rng.normal(0, np.sqrt(white_nm2 / 2 / modes), (nights, modes))
    noise = rng.normal(0, noise_nm, (nights, modes))
    return DAY_S * np.arange(nights), walk + own + noise, np.full((nights, modes), noise_nm)


@pytest.mark.slow
def test_the_interval_of_simulated_drifting_nights_holds_the_truth_as_often_as_it_says():
    """95 % nominally; of 40 series of nights at least 85 %, over all lags and for the time of validity."""
    rng, within, valid = np.random.default_rng(0), [], []
    for _ in range(40):
        nights = drifting(rng, 25, 27, 10.0, 20.0, 0.7)
        found, validity = with_confidence(structure_function(*nights), *nights, change_nm=20.0)
        truth = np.sqrt(10.0 + 20.0 * found.lag_s / DAY_S)
        within.append((found.low_nm <= truth) & (truth <= found.high_nm))
        valid.append(validity.low_days <= (20.0**2 - 10.0) / 20.0 <= validity.high_days)
    assert np.mean(within) >= 0.88 and np.mean(valid) >= 0.85


def test_nights_without_a_drift_have_no_end_of_validity():
    nights = drifting(np.random.default_rng(2), 25, 27, 10.0, 0.0, 0.7)
    _, validity = with_confidence(structure_function(*nights), *nights, change_nm=20.0)
    assert validity.high_days == np.inf and validity.low_days > validity.seen_days


def test_nights_that_change_more_at_once_are_not_valid_at_all():
    nights = drifting(np.random.default_rng(3), 25, 27, 900.0, 0.0, 0.7)
    _, validity = with_confidence(structure_function(*nights), *nights, change_nm=20.0)
    assert validity.days == 0.0


def test_calibrations_of_one_time_show_what_scatters_and_no_drift():
    nights = np.zeros(3), *drifting(np.random.default_rng(5), 3, 27, 50.0, 0.0, 0.7)[1:]
    found, validity = with_confidence(structure_function(*nights), *nights, change_nm=20.0)
    assert found.lag_s == [0.0] and np.isfinite([found.change_nm, found.low_nm, found.high_nm]).all()
    assert (validity.seen_days, validity.high_days) == (0.0, np.inf)
