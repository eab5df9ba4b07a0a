"""The experiment on seeing scales; truth from the moments of the log-normal law and from scipy's density."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.experiment_stage import context, section_of
from scipy.integrate import quad
from scipy.stats import lognorm

from irlos_pipe.conventions.errors import ConfigurationError
from irlos_pipe.conventions.seeing import SeeingScale
from irlos_pipe.instrument.instrument import load_instrument
from irlos_pipe.paper.common.results import Percentiles
from irlos_pipe.paper.seeing_scales import stage as seeing_scales
from irlos_pipe.paper.seeing_scales.experiment import (
    Site,
    condition,
    draw_seeing,
    log_normal_density,
)
from irlos_pipe.paper.seeing_scales.results import Relation
from irlos_pipe.paper.seeing_scales.section import section as seeing_scales_section

SITE = Site(0.7, 0.35, 0.15)
SCALE = SeeingScale(0.8, 0.0)
LAW = load_instrument("irlos").facility.residual_law
MANY = 200_000


def draws(site: Site = SITE, scale: SeeingScale = SCALE):
    return draw_seeing(site, scale, MANY, np.random.default_rng(1))


def run(seed: int = 0, **config):
    return seeing_scales.run(context(seeing_scales.Config(**config), seed))


def test_both_seeings_have_the_medians_and_scatters_of_their_log_normal_laws():
    found = draws()
    for values, median, scatter in (
        (found.monitor_arcsec, 0.7, 0.35),
        (found.sparta_arcsec, 0.56, np.hypot(0.35, 0.15)),
    ):
        logarithm = np.log(values)
        # four standard errors of the mean and of the standard deviation
        assert logarithm.mean() == pytest.approx(np.log(median), abs=4 * scatter / np.sqrt(MANY))
        assert logarithm.std() == pytest.approx(scatter, abs=4 * scatter / np.sqrt(2 * MANY))


def test_without_disagreement_one_seeing_follows_from_the_other():
    found = draws(replace(SITE, disagreement=0.0), SeeingScale(0.9, 0.05))
    assert np.allclose(found.sparta_arcsec, 0.9 * found.monitor_arcsec + 0.05)


def test_the_density_is_that_of_scipy_and_its_area_is_one():
    value = np.linspace(0.1, 3, 50)
    expected = lognorm(0.35, scale=0.7).pdf(value)
    assert np.allclose(log_normal_density(value, 0.7, 0.35), expected, rtol=1e-12)
    assert quad(log_normal_density, 1e-6, 20, (0.7, 0.35))[0] == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(("seeing_arcsec", "wfe_nm"), [(0.35, 95), (1.0, 163)])
def test_the_residual_of_the_simulated_conditions_is_that_of_the_test_report(seeing_arcsec, wfe_nm):
    assert LAW.wfe_nm(seeing_arcsec) == pytest.approx(wfe_nm, abs=0.5)


def test_how_rare_a_condition_is_follows_from_its_law():
    better = condition("sky", 1.0, SITE, SCALE, draws(), LAW).better
    expected = lognorm(np.hypot(0.35, 0.15), scale=0.56).cdf(1.0)
    assert better == pytest.approx(expected, abs=4 * np.sqrt(expected * (1 - expected) / MANY))


def test_the_error_of_a_translated_residual_is_its_scatter_among_simultaneous_measurements():
    """Monte Carlo: among draws in which the monitor sees the same, SPARTA's residual scatters as stated."""
    stated = condition("sky", SCALE.to_sparta(0.8), SITE, SCALE, draws(), LAW).wfe_sigma_nm
    alike = draws(replace(SITE, median_arcsec=0.8, scatter=1e-9))
    # to first order in the disagreement, whose square is 2 %
    assert LAW.wfe_nm(alike.sparta_arcsec).std() == pytest.approx(stated, rel=0.03)


def test_quantiles_are_those_of_a_normal_variable():
    found = Percentiles.of(np.random.default_rng(2).normal(3, 2, MANY), (16, 50, 84))
    # 16 % of a normal variable lie below 0.9945 standard deviations
    assert [found.p16, found.median, found.p84] == pytest.approx([1.011, 3, 4.989], abs=0.03)


def test_a_pessimistic_monitor_taken_for_sparta_overestimates_the_residual_everywhere():
    rows = run().results.conditions
    assert [row.where for row in rows] == ["simulation", "simulation", "sky", "sky", "sky"]
    for row in rows:
        excess = LAW.wfe_nm(row.monitor_arcsec) - LAW.wfe_nm(row.sparta_arcsec)
        assert row.wfe_untranslated_nm - row.wfe_nm == pytest.approx(excess) and excess > 0


def test_the_relation_is_the_profiles_unless_the_recipe_gives_another():
    own = load_instrument("irlos").seeing_scales["mass_dimm"]
    assert run().results.relation.ratio == own.ratio
    assert run().results.relation.status == "assumed"
    given = run(ratio=0.9, offset_arcsec=0.1).results
    assert given.relation == Relation(ratio=0.9, offset_arcsec=0.1, status="given", source="recipe")
    sky = [row for row in given.conditions if row.where == "sky"]
    assert [row.sparta_arcsec for row in sky] == pytest.approx([0.55, 1.18, 1.45])


def test_the_seed_decides_the_draws():
    first, same, other = (run(seed).arrays["draws/sparta_arcsec"].value for seed in (1, 1, 2))
    assert np.array_equal(first, same) and not np.array_equal(first, other)


def test_an_offset_that_makes_a_seeing_negative_is_refused():
    with pytest.raises(ConfigurationError, match=r"offset_arcsec = -0\.5: makes good seeing negative"):
        run(offset_arcsec=-0.5)


@pytest.mark.slow
def test_the_section_shows_the_relation_both_scales_and_every_condition():
    config = seeing_scales.Config(on_sky_arcsec=(0.65,))
    section = section_of(seeing_scales.run(context(config)), "seeing_scales", seeing_scales_section, config)
    *figures, table = section.blocks
    assert len(figures) == 3 and all("mass_dimm" in figure.svg for figure in figures)
    assert "SPARTA = 0.80 · mass_dimm +0.00 arcsec (assumed:" in section.lead
    assert [row[1:3] for row in table.rows] == [("0.35", "0.44"), ("1.00", "1.25"), ("0.52", "0.65")]
    # 104.27 nm per arcsec times 0.13 arcsec, the part that the monitor sees in excess
    assert table.rows[-1][-1] == "14 nm"


@pytest.mark.parametrize("monitor", ["mass_dim", "sparta"])
def test_an_unknown_monitor_is_named_with_those_known(monitor):
    with pytest.raises(ConfigurationError, match=f"monitor = '{monitor}': .* known: mass_dimm"):
        run(monitor=monitor)
