"""The experiment on seeing scales; truth from the moments of the log-normal law and from scipy's density."""

import numpy as np
import pytest
from helpers.experiment_stage import context, run_on, tables_of
from scipy.stats import lognorm

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.paper import seeing_scales

MANY = 200_000


def draws(seed: int = 1, **sizes):
    """Both seeings, (draws,)."""
    (star,) = seeing_scales.samples(context(seeing_scales.Sizes(draws=MANY, **sizes), seed))
    (row,) = seeing_scales.rows(star)
    return row["monitor_arcsec"], row["sparta_arcsec"]


def run(monkeypatch, **sizes) -> dict:
    return tables_of(run_on(monkeypatch, seeing_scales, seeing_scales.rows, **sizes))


def test_both_seeings_have_the_medians_and_scatters_of_their_log_normal_laws():
    monitor, sparta = draws()
    for values, median, scatter in ((monitor, 0.7, 0.35), (sparta, 0.56, np.hypot(0.35, 0.15))):
        logarithm = np.log(values)
        # four standard errors of the mean and of the standard deviation
        assert logarithm.mean() == pytest.approx(np.log(median), abs=4 * scatter / np.sqrt(MANY))
        assert logarithm.std() == pytest.approx(scatter, abs=4 * scatter / np.sqrt(2 * MANY))


def test_how_rare_a_condition_is_follows_from_its_law(monkeypatch):
    rows = run(monkeypatch, draws=MANY, simulated_arcsec=(1.0,))["conditions"]
    expected = lognorm(np.hypot(0.35, 0.15), scale=0.56).cdf(1.0)
    assert rows.better[0] == pytest.approx(expected, abs=4 * np.sqrt(expected * (1 - expected) / MANY))


def test_the_relation_is_the_profiles_unless_the_recipe_gives_another(monkeypatch):
    own = load_instrument("irlos").seeing_scales["mass_dimm"]
    relation = run(monkeypatch)["relation"].iloc[0]
    assert (relation.ratio, relation.status) == (own.ratio, "assumed")
    given = run(monkeypatch, ratio=0.9, offset_arcsec=0.1)
    assert given["relation"].iloc[0, :5].tolist() == ["mass_dimm", 0.9, 0.1, "given", "recipe"]
    assert given["conditions"].sparta_arcsec.tolist()[2:] == pytest.approx([0.55, 1.18, 1.45])


def test_what_cannot_be_drawn_is_refused():
    with pytest.raises(ConfigurationError, match=r"offset_arcsec = -0\.5: makes good seeing negative"):
        draws(offset_arcsec=-0.5)
    for monitor in ("mass_dim", "sparta"):
        with pytest.raises(ConfigurationError, match=f"monitor = '{monitor}': .* known: mass_dimm"):
            draws(monitor=monitor)
