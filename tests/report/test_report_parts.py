"""The parts of the report: numbers as text, names of modes, drawings."""

import numpy as np
import pytest
import scipy
from matplotlib.colors import AsinhNorm

from irlos_pipe.optics.zernike import zernike
from irlos_pipe.product.product import Product, Quantity
from irlos_pipe.report.curves import Look, chi2_figure, normal_quantiles, quantile_band, quantile_figure
from irlos_pipe.report.drawing import BLUE, CYCLE, INK, log_y, svg
from irlos_pipe.report.images import asinh_ticks, brightness_scale, image_panel, log_scale, thumbnail
from irlos_pipe.report.run_data import RunData
from irlos_pipe.report.section_diagnose import verdict_numbers, verdict_table
from irlos_pipe.report.section_lift import image_strip, prior_section, ramp_plot, residual_limit
from irlos_pipe.report.section_sensitivity import limit_text
from irlos_pipe.report.text import (
    MISSING,
    mode_name,
    number,
    parameter_rows,
    rounded_by_error,
    with_error,
    worded,
)
from irlos_pipe.stages.diagnose.results import Change, DiagnoseResults, StepRow
from irlos_pipe.stages.lift.results import Point
from irlos_pipe.stages.sensitivity import CurveRow

NAN = float("nan")


def draw_line(figure) -> None:
    figure.subplots().plot([0, 1], [0, 1], color=BLUE)


# -- text --------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [None, NAN, float("inf"), np.float32("nan")])
def test_what_is_missing_becomes_a_dash(value):
    assert number(value, ".2f", "nm") == MISSING


@pytest.mark.parametrize(
    ("value", "error", "expected"),
    [
        (1.25, 0.5, "+1.2 ± 0.5 nm"),
        (1.25, None, "+1.2 nm"),
        (-0.04, 0.5, "+0.0 ± 0.5 nm"),  # a zero has no minus
        (None, 0.5, MISSING),
        (NAN, NAN, MISSING),
    ],
)
def test_an_error_is_shown_where_there_is_one(value, error, expected):
    assert with_error(value, error, "+.1f", "nm") == expected


@pytest.mark.parametrize(
    ("value", "error", "expected"),
    [
        (0.04, 2.17e-05, "0.040000 ± 0.000022"),
        (-385.7013, 11.6092, "-386 ± 12"),
        (12345.0, 678.0, "12340 ± 680"),
        (0.0412345, None, "0.04123"),
        (0.0412345, 0.0, "0.04123"),
        (NAN, 1.0, MISSING),
    ],
)
def test_a_measured_number_has_the_digits_that_its_error_allows(value, error, expected):
    assert rounded_by_error(value, error) == expected


@pytest.mark.parametrize(("limit", "expected"), [(16.0, "≥ 16.0"), (15.2, "15.2"), (None, MISSING)])
def test_a_limit_at_the_end_of_the_grid_is_a_lower_limit(limit, expected):
    assert limit_text(CurveRow(limit_mag=limit, mag_j=[12.0, 16.0])) == expected


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("sep_mas", ("separation", "mas")),
        ("flux_ratio", ("flux ratio", "%")),
        ("zernike_nm 5", ("Noll 5", "nm")),
        ("mas_per_um", ("size", "mas/µm")),
        ("zernike_nm_per_um 4", ("Noll 4", "nm/µm")),
        ("piston_nm_from_mean 2", ("piston 2 − mean", "nm")),
        ("nm", ("size", "nm")),
        ("slope", ("slope", "")),
    ],
)
def test_a_parameter_has_its_unit_in_a_column_of_its_own(name, expected):
    assert worded(name) == expected


def test_parts_of_one_are_in_per_cent_and_pixels_say_row_and_column():
    assert parameter_rows({"fraction": 0.004}, {"fraction": 0.0002}) == [("fraction", "0.400 ± 0.020", "%")]
    assert parameter_rows({"pixels": [[47, 15]]}) == [("pixel", "row 47, column 15", "")]
    assert parameter_rows({"nm": None}) == [("size", MISSING, "nm")]


# -- modes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("noll", "expected"),
    [
        (2, "tilt x"),
        (4, "defocus"),
        (5, "astigmatism 45°"),
        (8, "coma x"),
        (12, "2nd astigmatism 0°"),
        (22, "2nd spherical"),
    ],
)
def test_modes_have_the_names_of_the_field(noll, expected):
    assert mode_name(noll) == expected


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


def test_a_drawing_takes_its_colours_from_the_page():
    drawing = svg("a", (3, 2), draw_line)
    assert "var(--blue)" in drawing
    assert "currentColor" in drawing and "width=" not in drawing.partition(">")[0]
    assert not any(colour in drawing for colour in (INK, *CYCLE))


@pytest.mark.parametrize(
    ("values", "expected"), [([1.0, NAN], "log"), ([NAN, -1.0], "linear"), ([], "linear")]
)
def test_an_axis_is_logarithmic_only_with_something_to_show(values, expected):
    seen = []

    def draw(figure) -> None:
        axes = figure.subplots()
        axes.plot(values)
        log_y(axes, np.array(values))
        seen.append(axes.get_yscale())

    svg("a", (3, 2), draw)
    assert seen == [expected]


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


def test_directions_of_travel_and_failed_fits_are_in_the_legend():
    introduced, found, converged = (0.0, 1.0, 0.5), (0.1, 1.1, NAN), (True, False, True)
    drawing = ramp_plot(
        [
            Point(introduced_nm=nm, defocus_nm=value, sigma_nm=1.0, converged=good)
            for nm, value, good in zip(introduced, found, converged, strict=True)
        ]
    )
    assert "defocus was raised" in drawing
    assert "defocus was lowered" not in drawing  # its only estimate is missing
    assert "not converged" in drawing


@pytest.mark.slow
def test_a_strip_shows_no_more_than_fits():
    offsets, images = np.arange(30.0), np.ones((30, 4, 4))
    drawing = image_strip(offsets, images, images, 0.1)
    assert "+0 nm" in drawing
    assert "+29 nm" in drawing
    assert drawing.count("<image") == 27 + 3  # one colour bar for every row


def test_the_residual_scale_is_relative_to_the_models_peak():
    model = np.full((2, 4, 4), 50.0)
    assert residual_limit(model + 5, model) == pytest.approx(0.1)


@pytest.mark.slow
def test_the_prior_of_ten_thousand_frames_takes_little_more_room_than_that_of_some_hundred():
    def drawn(frames: int) -> int:
        values = np.random.default_rng(1).standard_normal(frames)
        arrays = {name: Quantity(values, "nm") for name in ("ratio", "defocus_nm", "introduced_nm")}
        run = RunData({}, "", "ok", "", "", {"prior": Product("prior", arrays, {})}, [])
        return sum(len(block.svg) for block in prior_section(run).blocks)

    assert drawn(10_000) < 2 * drawn(300)


def test_a_list_of_pixels_is_counted_in_its_tile():
    step = StepRow(effect="bad_pixels", parameters={"pixels": [[24, 9], [25, 9], [32, 32]]})
    found = DiagnoseResults(verdict="effect", grade="partial", steps=[step])
    (tile,) = [one for one in verdict_numbers(found) if "bad pixels" in one.label]
    assert tile.value == "3 pixels" and tile.note.count("row") == 3


@pytest.mark.parametrize(
    ("nearest", "note"),
    [
        (None, "before → after; noise alone gives 1"),
        ("ghost", "before → with ghost, not named; noise alone gives 1"),
    ],
)
def test_the_tile_of_chi2_says_whose_fit_it_means(nearest, note):
    found = DiagnoseResults(
        verdict="unknown",
        grade="resembles",
        nearest=StepRow(effect=nearest) if nearest else None,
        chi2_nu=Change(before=9.9, after=1.1),
    )
    (tile,) = [one for one in verdict_numbers(found) if one.label == "χ²/ν"]
    assert (tile.value, tile.note) == ("9.90 → 1.10", note)


def test_a_diagnosis_shows_the_values_of_facts_that_it_leaves_free():
    """A scale that differs by a thousandth is a different one, and is shown so."""
    facts = {"plate_scale": {"scale": 1.0032, "rotation_deg": -0.4}, "pupil_misregistration": {"x_m": 0.03}}
    table = verdict_table(DiagnoseResults(open_facts=facts, model="model.yaml"))
    shown = dict(table.rows)["free in model.yaml as well"]
    assert "plate scale" in shown and "1.003" in shown and "-0.4 °" in shown and "0.03 m" in shown


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


def test_frames_are_drawn_beside_what_a_right_model_gives():
    figure = chi2_figure("c", np.array([1.9, np.nan, 2.4]), 2.2, 4.4)
    assert "nominal, 2.20" in figure.svg and "limit of the median, 4.40" in figure.svg
    assert "nominal" not in chi2_figure("c", np.array([1.9]), np.nan, np.nan).svg
    assert chi2_figure("c", np.full(3, np.nan), 2.2, 4.4) is None
