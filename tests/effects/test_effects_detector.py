"""Detector effects, and what effects tell about themselves. Truth: sums over kernels by scipy, analysis."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.effect_cases import CONDITIONS, STRONG, made
from scipy.ndimage import convolve
from scipy.special import j0

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.effects import CATALOGUE
from irlos_pipe.effects.base import FixedEffect
from irlos_pipe.effects.detector import BadPixels, DetectorNonlinearity
from irlos_pipe.effects.motion import j0_of_twice_root
from irlos_pipe.numerics.directional import Directional


@pytest.fixture
def images() -> np.ndarray:
    return np.random.default_rng(3).uniform(10, 1000, (2, 12, 9))


def through(name: str, images: np.ndarray) -> np.ndarray:
    effect, values = made(name)
    return effect.apply(values, torch.as_tensor(images)).numpy()


def test_crosstalk_gives_each_neighbour_a_quarter_of_what_leaves_a_pixel(images):
    kernel = np.array([[0, 0.02, 0], [0.02, 0.92, 0.02], [0, 0.02, 0]])
    expected = [convolve(image, kernel, mode="nearest") for image in images]
    assert through("interpixel_crosstalk", images) == pytest.approx(np.array(expected))


def test_nonlinearity_takes_its_fraction_at_the_peak_and_its_square_below(images):
    expected = [image * (1 - 0.06 * image / image.max()) for image in images]
    assert through("detector_nonlinearity", images) == pytest.approx(np.array(expected))


def test_a_gradient_rises_towards_its_angle_and_averages_out(images):
    added = through("background_gradient", images)[0] - images[0]
    assert added.mean() == pytest.approx(0, abs=1e-12)
    assert added[0, 1] - added[0, 0] == pytest.approx(4 * np.cos(np.deg2rad(30)))
    assert added[1, 0] - added[0, 0] == pytest.approx(4 * np.sin(np.deg2rad(30)))


def test_bad_pixels_are_masked_or_have_an_offset_of_their_own(images):
    effect = BadPixels([(4, 7), (2, 0)])
    assert np.argwhere(~effect.good_pixels((12, 9))).tolist() == [[2, 0], [4, 7]]
    added = effect.apply(torch.tensor([50.0, -30.0]).double(), torch.as_tensor(images)).numpy() - images
    assert (added[:, 4, 7], added[:, 2, 0]) == (pytest.approx([50, 50]), pytest.approx([-30, -30]))
    assert np.count_nonzero(np.abs(added) > 1e-9) == 4


@pytest.mark.parametrize(
    "effect",
    [
        *(FixedEffect(*made(name)) for name in CATALOGUE if CATALOGUE[name].plane == "detector"),
        FixedEffect(DetectorNonlinearity(peak_e=900.0), [0.1]),
    ],
    ids=lambda one: f"{one.name}{' at a known signal' if getattr(one.base, 'peak_e', None) else ''}",
)
def test_changes_of_images_are_pushed_through_as_finite_differences_are(effect):
    nothing, step, rng = torch.zeros(0).double(), 1e-4, np.random.default_rng(5)
    before = torch.as_tensor(rng.uniform(10, 1000, (2, 36, 33)))
    changes = torch.as_tensor(rng.normal(0, 30, (2, 3, 36, 33)))
    moved = [effect.apply(nothing, (before[:, None] + way * step * changes).flatten(0, 1)) for way in (1, -1)]
    expected = (moved[0] - moved[1]).view_as(changes) / (2 * step)
    assert effect.pushed(nothing, before, changes).numpy() == pytest.approx(expected.numpy(), abs=1e-6)


@pytest.mark.parametrize("largest", [1e-6, 1.0, 60.0])
def test_the_bessel_factor_and_its_slope_are_those_of_scipy(largest):
    w = torch.linspace(0, largest, 7, dtype=torch.float64)
    value = j0_of_twice_root(w)
    slope = Directional(j0_of_twice_root, w).along(torch.ones_like(w))
    assert value.numpy() == pytest.approx(j0(2 * np.sqrt(w.numpy())), abs=1e-6)  # of PyTorch itself
    h = 1e-4 * largest
    inside = w.numpy()[1:-1]
    expected = (j0(2 * np.sqrt(inside + h)) - j0(2 * np.sqrt(inside - h))) / (2 * h)
    assert slope.numpy()[1:-1] == pytest.approx(expected, abs=1e-5)
    assert slope[0] == pytest.approx(-1)


def test_the_bessel_factor_can_be_differentiated_backwards():
    w = torch.tensor([0.0, 0.5, 3.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(j0_of_twice_root, w.detach()[1:].requires_grad_())
    j0_of_twice_root(w).sum().backward()
    assert w.grad[0] == pytest.approx(-1)


@pytest.mark.parametrize("name", STRONG)
def test_public_values_survive_the_way_to_the_solver_and_back_where_they_are_plausible(name):
    effect, values = made(name)
    for parameter, value in zip(effect.parameters, values, strict=True):
        assert parameter.lower <= parameter.start <= parameter.upper
        assert parameter.plausible[0] <= value <= parameter.plausible[1]
    described = effect.describe(values.numpy())
    for key, value in STRONG[name].items():
        back = {int(k): v for k, v in described[key].items()} if isinstance(value, dict) else described[key]
        assert back == pytest.approx(value) if key != "pixels" else back == value


@pytest.mark.parametrize(
    ("name", "values", "wanted"),
    [
        ("pupil_misregistration", [0.0, 0.3, 3.9], "vanes turned by +3.9° against the profile"),
        ("pupil_misregistration", [0.1, 0.0, -0.02], "a stop +0.100, +0.000 m off"),
        ("pupil_geometry", [1.21, 0.0401], "a central obscuration of 1.21 m instead of 1.12 m"),
        ("pupil_geometry", [1.117, 0.05], "vanes 0.050 m wide instead of 0.040 m"),
        ("plate_scale", [0.01], "pixels of 9.797 mas instead of 9.700 mas"),
        ("anamorphism", [0.006, 0.0], "an image 0.60 % larger along 0° than across"),
        ("anamorphism", [0.0, -0.02], "an image 2.00 % larger along 135° than across"),
        ("spectrum", [20.0, 0.0, 0.1], "a spectrum about 1469.3 nm instead of 1449.3 nm, 1.10 times as wide"),
    ],
)
def test_a_fact_told_wrong_is_named_with_the_wanted_and_the_told_value(name, values, wanted):
    effect = CATALOGUE[name].under(CONDITIONS)
    assert effect.phrase(effect.describe(np.array(values))) == wanted


@pytest.mark.parametrize("name", ["phase_bump", "pupil_spot"])
def test_places_are_looked_for_all_over_a_pupil_of_any_size(name):
    geometry = PupilGeometry(diameter_m=5.0, obscuration_m=1.8)
    smaller = replace(CONDITIONS, settings=replace(CONDITIONS.settings, geometry=geometry))
    radii = {}
    for conditions in (CONDITIONS, smaller):
        tried = CATALOGUE[name].under(conditions).candidates((64, 64), 9.7)
        places = np.array([one.values[1:3] for one in tried])
        radii[conditions.settings.geometry.diameter_m] = np.hypot(*places.T)
    assert radii[5.0] == pytest.approx(5.0 / 8.0 * radii[8.0])
    assert 3.6 < radii[8.0].max() < 4.0
