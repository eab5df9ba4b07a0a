"""What a number is held against: errors when nights are few, limits, all modes together.

Truth: rates of false alarms by Monte Carlo with a seed, and cases by hand.
"""

import numpy as np
import pytest
from helpers.stored_nights import dates, measured, put

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.night.bands import History, band_of, bands, excess_scatter, wavefront_test
from irlos_pipe.night.settings import BandSettings, load_settings
from irlos_pipe.night.stability import Validity
from irlos_pipe.night.trend import make_trend
from irlos_pipe.night.trend_text import validity_text

RULE = BandSettings()
FIVE = [0.0, 0.5, -0.5, 0.3, -0.2]


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
    rng, rule, trials, modes = np.random.default_rng(nights), BandSettings(false_alarm=0.02), 150, 20
    single = whole = 0
    for _ in range(trials):
        values, past = drawn(rng, nights, modes, excess)
        found = [band_of(one, 0.5, rule, excess_scatter(past)) for one in past]
        single += sum(not band.holds(value) for band, value in zip(found, values[-1], strict=True))
        whole += not wavefront_test(values[-1], found, rule).holds(0.0)
    assert single <= 0.02 * trials * modes and whole <= 0.02 * trials + 3 * np.sqrt(0.02 * trials)


def test_a_change_that_no_single_mode_shows_alarms_as_a_wavefront():
    past = [History(np.array(FIVE) * sign, np.full(5, 0.5)) for sign in (1, -1) * 13]
    found = [band_of(one, 0.5, RULE, excess_scatter(past)) for one in past]
    shifted = [band.centre + 2.0 for band in found]
    assert all(band.holds(value) for band, value in zip(found, shifted, strict=True))
    test = wavefront_test(shifted, found, RULE)
    assert not test.holds(0.0) and test.change_nm == pytest.approx(2.0 * np.sqrt(26))


def test_the_band_of_an_rms_does_not_reach_below_zero(tmp_path):
    from irlos_pipe.night.database import opened

    for day, value in enumerate([40.0, 90.0, 45.0, 95.0, 60.0, 70.0]):
        put(tmp_path, day, measured(ncpa_nm=value, defocus_bias_nm=value - 60))
    with opened(tmp_path) as database:
        series = {one.name: one for one in make_trend(database.points(), (), RULE).series}
    assert series["ncpa_nm"].bands[-1].low == 0.0 and series["defocus_bias_nm"].bands[-1].low < 0


def test_limits_of_the_configuration_alarm_from_the_first_night_and_for_the_sky_too(tmp_path):
    from irlos_pipe.night.database import opened

    put(tmp_path, 0, measured(noll_4_nm=25.0, noll_5_nm=5.0, seeing_arcsec=2.0))
    rule = BandSettings(limits={"noll_4_nm": (-20, 20), "seeing_arcsec": (None, 1.5), "noll_5_nm": (0, None)})
    with opened(tmp_path) as database:
        alarms = make_trend(database.points(), (), rule).alarms()
    assert [point.name for point, _ in alarms] == ["noll_4_nm", "seeing_arcsec"]
    assert alarms[0][1].text(25.0) == "25 outside the limits -20 to 20"


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ("{noll_4: [-20, 20]}", "is no number of a trend"),
        ("{ncpa_nmm: [0, 20]}", "did you mean 'ncpa_nm'"),
        ("{noll_4_nm: [20, -20]}", "not below"),
        ("{noll_4_nm: [null, null]}", "leave it out"),
    ],
)
def test_wrong_limits_are_refused(tmp_path, limits, message):
    (tmp_path / "night.yaml").write_text(f"band:\n  limits: {limits}\n")
    with pytest.raises(ConfigurationError, match=message):
        load_settings(tmp_path / "night.yaml")


def test_how_long_a_calibration_is_valid_is_one_sentence():
    inf = float("inf")
    assert validity_text(Validity(20.0, 12.0, 8.0, 19.0, 30.0)) == (
        "The NCPAs stay within 20 nm RMS for 12 days (95 %: 8 to 19)."
    )
    assert "at least 30 days" in validity_text(Validity(20.0, inf, 400.0, inf, 30.0))
    assert "at least 9 days" in validity_text(Validity(20.0, 300.0, 9.0, inf, 30.0))
    assert "for 4 days (95 %: 1.5 or more)" in validity_text(Validity(20.0, 4.0, 1.5, inf, 30.0))
    assert "From one calibration to the next" in validity_text(Validity(20.0, 0.0, 0.0, 3.0, 30.0))
