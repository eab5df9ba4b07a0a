"""What a number is held against: the nights before, errors when nights are few, limits, all modes together.

Truth: rates of false alarms by Monte Carlo with a seed, and cases by hand.
"""

import numpy as np
import pytest
from helpers.stored_nights import bands, dates, measured, put

from irlos_pipe.night.bands import History, band_of, excess_scatter, wavefront_test
from irlos_pipe.night.settings import BandSettings
from irlos_pipe.night.trend import read_trend

RULE, LOOSE = BandSettings(), BandSettings(false_alarm=1e-2, nights=60, least_nights=5)
FIVE = [0.0, 0.5, -0.5, 0.3, -0.2]


def band_of_last(values, sigma=None, rule=LOOSE):
    return bands(dates(len(values)), values, [*[None] * (len(values) - 1), sigma], rule)[-1]


@pytest.mark.slow
@pytest.mark.parametrize("nights", [5, 10, 40])
@pytest.mark.parametrize("probability", [0.05, 0.01])
def test_false_alarms_are_not_more_frequent_than_requested(nights, probability):
    rng, trials = np.random.default_rng(nights), 1000
    rule = BandSettings(false_alarm=probability, least_nights=nights)
    draws = rng.normal(size=(trials, nights + 1))
    alarms = sum(not band_of_last(values, rule=rule).holds(values[-1]) for values in draws)
    allowed = trials * probability + 3 * np.sqrt(trials * probability)
    assert alarms <= allowed and alarms >= 0.2 * trials * probability


def test_outlying_nights_hardly_move_the_band():
    values = np.random.default_rng(6).normal(0, 1, 41)
    clean = band_of_last(values)
    values[3:11] = 1000.0
    shifted = band_of_last(values)
    assert abs(shifted.centre - clean.centre) < 1 and shifted.half_width < 3 * clean.half_width


def test_several_recordings_of_a_night_count_once_and_do_not_define_their_own_band():
    nights = [*dates(6), *["2024-02-01"] * 3]
    found = bands(nights, [0, 1, 2, 3, 4, 5, 100, 200, 300], [None] * 9, LOOSE)
    assert [band.nights if band else None for band in found] == [None] * 5 + [5, 6, 6, 6]
    assert found[6] == found[7] == found[8] and found[6].centre == 2.5


def test_only_the_latest_nights_define_the_band_and_too_few_give_none():
    values = [*[0.0] * 10, *np.arange(100.0, 120.0), 0.0]
    rule = BandSettings(false_alarm=1e-2, nights=20)
    assert band_of_last(values, rule=rule).centre == 109.5
    assert band_of_last(values[:5]) is None


def test_a_value_with_a_large_error_has_a_wide_band():
    values = np.random.default_rng(7).normal(0, 1, 31)
    narrow, wide = band_of_last(values), band_of_last(values, sigma=50.0)
    assert narrow.half_width < 6 and wide.half_width > 100


def drawn(rng, nights: int, modes: int, excess: float, error: float = 0.5):
    """Values (nights + 1, modes) that scatter by `excess` times their errors, and their histories."""
    values = rng.normal(0, excess * error, (nights + 1, modes))
    return values, [History(values[:nights, mode], np.full(nights, error)) for mode in range(modes)]


def test_after_five_nights_of_half_a_nanometre_a_change_of_five_alarms():
    band = bands(dates(6), [*FIVE, 5.0], [0.5] * 6, RULE)[-1]
    assert not band.holds(5.0) and band.holds(0.0) and band.holds(2.0)
    assert bands(dates(6), [*FIVE, 5.0], [None] * 6, RULE)[-1].holds(5.0)  # as without errors


def test_a_scatter_beyond_the_errors_widens_the_band():
    quiet, restless = (
        bands(dates(6), [*(scale * np.array(FIVE)), 0.0], [0.5] * 6, RULE)[-1] for scale in (1, 10)
    )
    assert restless.half_width > 3 * quiet.half_width


def test_many_modes_show_by_how_much_errors_are_too_small():
    for excess in (1.0, 3.0):
        _, modes = drawn(np.random.default_rng(1), 10, 40, excess)
        assert excess_scatter(modes) == pytest.approx(excess, rel=0.15)
    assert excess_scatter(drawn(np.random.default_rng(1), 10, 40, 0.2)[1]) == 1.0
    assert excess_scatter([]) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("nights", "excess"), [(3, 1.0), (5, 3.0), (20, 3.0)])
def test_false_alarms_of_modes_and_wavefronts_are_not_more_frequent_than_requested(nights, excess):
    rng, rule, trials, modes = np.random.default_rng(nights), BandSettings(false_alarm=0.02), 75, 20
    single = whole = 0
    for _ in range(trials):
        values, past = drawn(rng, nights, modes, excess)
        found = [band_of(one, 0.5, rule, excess_scatter(past)) for one in past]
        single += sum(not band.holds(value) for band, value in zip(found, values[-1], strict=True))
        whole += not wavefront_test(values[-1], found, rule).holds
    assert single <= 0.02 * trials * modes and whole <= 0.02 * trials + 3 * np.sqrt(0.02 * trials)


def test_a_change_that_no_single_mode_shows_alarms_as_a_wavefront():
    past = [History(np.array(FIVE) * sign, np.full(5, 0.5)) for sign in (1, -1) * 13]
    found = [band_of(one, 0.5, RULE, excess_scatter(past)) for one in past]
    shifted = [band.centre + 2.0 for band in found]
    assert all(band.holds(value) for band, value in zip(found, shifted, strict=True))
    test = wavefront_test(shifted, found, RULE)
    assert not test.holds and test.change_nm == pytest.approx(2.0 * np.sqrt(26))


def test_the_band_of_an_rms_does_not_reach_below_zero(tmp_path):
    for day, value in enumerate([40.0, 90.0, 45.0, 95.0, 60.0, 70.0]):
        put(tmp_path, day, measured(ncpa_nm=value, defocus_bias_nm=value - 60))
    low = {one.name: one.last.band.low for one in read_trend(tmp_path, RULE).series}
    assert low["ncpa_nm"] == 0.0 and low["defocus_bias_nm"] < 0


def test_limits_of_the_configuration_alarm_from_the_first_night_and_for_the_sky_too(tmp_path):
    run = put(tmp_path, 0, measured(noll_4_nm=25.0, noll_5_nm=5.0, seeing_arcsec=2.0))
    rule = BandSettings(limits={"noll_4_nm": (-20, 20), "seeing_arcsec": (None, 1.5), "noll_5_nm": (0, None)})
    assert read_trend(tmp_path, rule).alarms() == [
        f"{run}: noll_4_nm = 25 outside the limits -20 to 20",
        f"{run}: seeing_arcsec = 2 outside the limits to 1.5",
    ]
