"""Plots of how well a model fits. Truth: scipy.stats, Monte Carlo."""

import numpy as np
import pytest
import scipy

from irlos_pipe.report.misfit_plots import chi2_figures, normal_quantiles, quantile_band, quantile_figures
from irlos_pipe.report.quality_plots import Look

LOOK = Look("residual", "#000000")


def test_the_expected_quantiles_are_means_of_order_statistics():
    draws = np.sort(np.random.default_rng(1).normal(size=(20000, 25)), axis=1)
    assert normal_quantiles(25) == pytest.approx(draws.mean(0), abs=0.02)  # 5 standard errors at the ends


def test_the_band_holds_nineteen_of_twenty_images_at_every_rank():
    draws = np.sort(np.random.default_rng(2).normal(size=(8000, 40)), axis=1)
    low, high = quantile_band(40)
    inside = ((draws >= low) & (draws <= high)).mean(0)
    assert inside == pytest.approx(0.95, abs=0.0125)  # 5 standard errors


def test_the_middle_of_the_band_is_the_median():
    low, high = quantile_band(101)
    median = scipy.stats.beta(51, 51).ppf([0.025, 0.975])
    assert [low[50], high[50]] == pytest.approx(scipy.stats.norm.ppf(median))


def test_masked_pixels_do_not_count_and_a_handful_is_no_plot():
    image = np.full((8, 8), np.nan)
    image[:2] = 1.0
    assert quantile_figures("q", {LOOK: image}) == []
    image[:3] = 1.0
    (figure,) = quantile_figures("q", {LOOK: image})
    assert "residual [σ]" in figure.svg


def test_frames_are_drawn_beside_what_a_right_model_gives():
    (figure,) = chi2_figures("c", np.array([1.9, np.nan, 2.4]), 2.2, 4.4)
    assert "2.20 (dashed)" in figure.caption and "up to 4.40" in figure.caption
    (bare,) = chi2_figures("c", np.array([1.9]), np.nan, np.nan)
    assert "right model" not in bare.caption and "Grey" not in bare.caption
    assert chi2_figures("c", np.full(3, np.nan), 2.2, 4.4) == []
