"""Facts that a diagnosis frees, other sides of what has a direction, and sizes that are seen.

Frames are drawn from the model itself (same code). Truth: fits from elsewhere, what was put into the frames,
and Monte Carlo.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.diagnose_frames import CASE, CONDITIONS, OPTIONS, cube, fitted, image

from irlos_pipe.diagnosis.acceptance import Accepted, Search, gap_between
from irlos_pipe.diagnosis.checks import judge_noise
from irlos_pipe.diagnosis.conclude import _adjusted, conclude
from irlos_pipe.diagnosis.effect_sizes import Covariances
from irlos_pipe.diagnosis.fitting import Fitter
from irlos_pipe.diagnosis.null_model import SURELY, Optimum, gaussian_sigma, surely_exceeding
from irlos_pipe.diagnosis.verdict import Adjusted
from irlos_pipe.diagnosis.workflow import open_facts, opposite_side
from irlos_pipe.effects import CATALOGUE, FixedEffect, everyday
from irlos_pipe.optics.psf_settings import KnownWavefront
from irlos_pipe.stages.diagnose.work import model_entries

pytestmark = pytest.mark.xdist_group("facts")  # its fixtures serve all tests

STOP = CATALOGUE["pupil_misregistration"].under(CONDITIONS)
SCALE = CATALOGUE["plate_scale"].under(CONDITIONS)
COMPANION = CATALOGUE["companion"].under(CONDITIONS)
TRUE, FREE = (0.06, -0.6, 1.0), [parameter.name for parameter in STOP.parameters]


@pytest.fixture(scope="module")
def off_centre():
    """Frames behind a stop that is off, and a fit with it and the plate scale."""
    training = cube(image(effect=STOP, values=TRUE)).training
    return training, fitted(training, [FixedEffect(STOP, TRUE, FREE), SCALE])


@pytest.mark.slow
def test_the_opposite_side_is_said_where_nothing_tells_the_sides_apart():
    """Without any wavefront the image is |FT|² of a real pupil, which is even: both sides make the same."""
    flat_nm = {6: -CASE.known.total_nm[6]}
    training = cube(image(flat_nm, STOP, TRUE)).training
    model = fitted(training, [FixedEffect(STOP, TRUE, FREE)])
    side = opposite_side(Fitter(model.views, training), Optimum(training, model), STOP.name, 5.0)
    true = STOP.describe(np.array(TRUE))
    found = model.effect(STOP.name).base.describe(model.values_of(STOP.name))
    assert abs(side.chi2_rise) < 4.0
    for key in ("dx_m", "dy_m"):
        assert side.parameters[key] == pytest.approx(-true[key], abs=0.01)
        assert found[key] == pytest.approx(true[key], abs=0.01)
    assert side.parameters["rotation_deg"] == pytest.approx(true["rotation_deg"], abs=0.5)
    sized = Adjusted(FixedEffect(STOP, TRUE), true, {}, opposite=side, label=STOP.name, significance=9.0)
    assert sized.phrase.startswith("vanes turned by +1.0°") and side.phrase in sized.phrase


@pytest.mark.slow
def test_the_opposite_side_is_not_said_where_the_diversity_excludes_it_or_there_is_none(off_centre):
    training, model = off_centre
    fitter, final = Fitter(model.views, training), Optimum(training, model)
    assert opposite_side(fitter, final, STOP.name, 5.0) is None
    assert opposite_side(fitter, final, SCALE.name, 5.0) is None
    assert opposite_side(fitter, final, "drift", 5.0) is None  # which no fit of the mean image has


def test_of_two_effects_that_scale_the_image_one_is_free():
    colour = CATALOGUE["spectrum"].under(CONDITIONS)
    assert [one.name for one in everyday([CONDITIONS], []) if one.name in {"plate_scale", "spectrum"}] == [
        "plate_scale"
    ]
    assert not {"plate_scale", "spectrum"} & {one.name for one in everyday([CONDITIONS], [colour])}


def test_a_diversity_error_is_free_only_beside_a_recording_with_another_diversity():
    settings = replace(CONDITIONS.settings, known=KnownWavefront({6: 100.0}))
    other = replace(CONDITIONS, settings=settings)
    names = [{one.name for one in everyday(some, [])} for some in ([CONDITIONS] * 2, [CONDITIONS, other])]
    assert ["diversity_error" in some for some in names] == [False, True]


def test_what_was_adjusted_is_handed_on_by_its_label_if_there_are_two_of_a_kind():
    copies = [FixedEffect(COMPANION, (0.02, 150.0, 40.0 * n), ["flux_ratio"]) for n in (-1, 1)]
    training = cube(image(effect=COMPANION, values=(0.02, 150.0, 40.0))).training
    model = fitted(training, copies)
    search = SimpleNamespace(final=Optimum(training, model), adjusted=["companion_2"])
    (one,) = _adjusted(search, Covariances(training, model))
    assert one.label == "companion_2"
    assert one.public["flux_ratio"] == pytest.approx(0.02, abs=5 * one.sigma["flux_ratio"])
    assert one.public["pa_deg"] == pytest.approx(np.rad2deg(np.arctan2(40, 150)))
    assert one.significance == pytest.approx(one.public["flux_ratio"] / one.sigma["flux_ratio"])
    assert one.phrase.startswith("a second source of ")


def test_where_nothing_is_named_the_nearest_is_said_with_its_size():
    """A companion, and squares of a chessboard, which nothing explains."""
    chess_e = 10.0 * (-1.0) ** np.add.outer(*map(np.arange, CASE.window))
    data = cube(image(effect=COMPANION, values=(0.02, 90.0, -60.0)) + 50.0 + chess_e)
    near = FixedEffect(COMPANION, (0.01, 85.0, -65.0), [one.name for one in COMPANION.parameters])
    without, with_it = (Optimum(data.training, fitted(data.training, some)) for some in ([], [near]))
    gap = gap_between(data.held_out, without.fitted, with_it.fitted)
    nearest = Accepted(without, with_it.fitted, COMPANION.name, 9.0, 9.0, gap)
    search = Search(without, with_it, None, [], [], [], nearest=nearest)
    found = conclude(data, search, judge_noise(data.training.parts[0]), OPTIONS)
    assert (found.verdict, found.steps) == ("unknown", [])
    assert found.nearest.name == COMPANION.name
    angle_deg = np.rad2deg(np.arctan2(-60, 90)) % 360
    for key, value in {"flux_ratio": 0.02, "sep_mas": np.hypot(90, 60), "pa_deg": angle_deg}.items():
        assert found.nearest.public[key] == pytest.approx(value, abs=5 * found.nearest.sigma[key]), key
    assert 0 < found.nearest.sigma["flux_ratio"] < 0.002
    assert found.nearest.share > 0.9


# -- facts that are left free --------------------------------------------------------------------


def test_facts_that_are_off_are_left_free_where_they_fit_best_unless_they_are_named(off_centre):
    training, model = off_centre
    final = Optimum(training, model)
    (stop,) = open_facts(final, [])  # the scale is as declared
    assert stop.values[:2] == pytest.approx(TRUE[:2], abs=0.2)
    assert stop.values[2] == pytest.approx(TRUE[2], abs=0.5)
    assert open_facts(final, [STOP.name]) == []


def test_the_model_of_a_recipe_has_them_free_from_there():
    result = SimpleNamespace(steps=[], adjusted=[], open_facts=[FixedEffect(STOP, TRUE)])
    (entry,) = model_entries(result)
    assert entry[STOP.name]["fit"] is True
    assert entry[STOP.name]["rotation_deg"] == pytest.approx(1.0)


@pytest.mark.parametrize("frames", [1.0, 1.5, 3.0])
def test_fewer_independent_frames_than_directions_are_no_error_and_little_evidence(frames):
    """One frame may say anything of three directions: T² must be enormous to mean something."""
    found = [gaussian_sigma(value, 3, frames) for value in (1.0, 100.0, 1e6)]
    assert np.isfinite(found).all()
    assert found == sorted(found)
    assert found[1] < 3 < gaussian_sigma(100.0, 3, np.inf)


@pytest.mark.parametrize(("limit", "directions"), [(36.0, 1), (45.0, 3), (100.0, 28)])
def test_an_effect_of_the_smallest_detectable_size_is_nearly_always_seen(limit, directions):
    """Monte Carlo: normal deviates that are off by this size exceed the limit as often as stated."""
    size = np.sqrt(surely_exceeding(limit, directions) / directions)
    drawn = np.random.default_rng(3).normal(size, 1.0, (40_000, directions))
    assert np.mean((drawn**2).sum(1) > limit) == pytest.approx(SURELY, abs=0.005)
