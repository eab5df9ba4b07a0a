"""The parts of the report: names of modes, drawings."""

import numpy as np
import pytest
import scipy
from matplotlib.colors import AsinhNorm

from irlos_pipe.optics.zernike import zernike
from irlos_pipe.product.product import Product, Quantity
from irlos_pipe.product.results import RunResults
from irlos_pipe.report.drawing import Look, normal_quantiles, quantile_band, quantile_figure
from irlos_pipe.report.images import asinh_ticks, brightness_scale, image_panel, log_scale, thumbnail
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_lift import prior_section
from irlos_pipe.report.text import (
    mode_name,
)

NAN = float("nan")


# -- modes -------------------------------------------------------------------------------------


def test_no_two_modes_share_a_name():
    names = [mode_name(noll) for noll in range(1, 232)]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("noll", [noll for noll in range(5, 31) if noll not in (11, 22)])
def test_the_direction_in_a_name_is_where_the_mode_is_extreme(noll):
    name = mode_name(noll)
    if name.endswith("°"):
        angle = np.deg2rad(float(name.split()[-1][:-1]))
    else:
        angle = {"x": 0.0, "y": np.pi / 2}[name[-1]]
    around = np.linspace(0, 2 * np.pi, 721)
    edge = zernike(noll, np.cos(around), np.sin(around))
    there = zernike(noll, np.array([np.cos(angle)]), np.array([np.sin(angle)]))
    assert abs(there[0]) == pytest.approx(np.abs(edge).max(), rel=1e-4)


# -- drawings ----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("image", [np.full((4, 4), NAN), np.zeros((4, 4)), -np.ones((4, 4))])
def test_images_without_light_can_be_drawn(image):
    for scale in (brightness_scale(image), log_scale(image)):
        assert image_panel("a", image, scale, None, "e-").startswith("<svg")
    assert "data:image/png" in thumbnail(image)


@pytest.mark.parametrize("limit", [5.0, 40.0, 700.0, 2e5])
@pytest.mark.parametrize("low", [0.0, -1.0])
def test_numbers_beside_an_asinh_scale_have_room(limit, low):
    scale = AsinhNorm(1.0 if low else 3e-3 * limit, low * limit, limit)
    places = np.asarray(scale(np.array(asinh_ticks(scale))))
    assert len(places) >= 3
    assert np.diff(places).min() > 0.07
    assert places.min() >= 0 and places.max() <= 1


@pytest.mark.slow
def test_the_prior_of_ten_thousand_frames_takes_little_more_room_than_that_of_some_hundred():
    def drawn(frames: int) -> int:
        values = np.random.default_rng(1).standard_normal(frames)
        arrays = {name: Quantity(values, "nm") for name in ("ratio", "defocus_nm", "introduced_nm")}
        run = RunData({}, "", RunResults(), {"prior": Product("prior", arrays, {})}, [])
        return sum(len(block.svg) for block in prior_section(run).blocks)

    assert drawn(10_000) < 2 * drawn(300)


# -- how well a model fits; truth: scipy.stats, Monte Carlo -------------------------------------

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
    assert quantile_figure("q", {LOOK: image}) is None
    image[:3] = 1.0
    figure = quantile_figure("q", {LOOK: image})
    assert "residual [σ]" in figure.svg
