"""The focus sensor of a loop. Truth: the wavefronts that images are drawn from, LIFT by its own solver and
start, the table that batches use, and the statistics of many draws."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases
from scipy.ndimage import gaussian_filter

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.focus import Focus, Limits
from irlos_pipe.estimate.lift import lift
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.focus_table import FocusImages, FocusTable, Reach
from irlos_pipe.optics.grids import Optics
from irlos_pipe.optics.psf import PsfModel

TWO_COLOURS = ((1215.0, 0.5), (1625.0, 0.5))
WINDOW = (48, 40)
SETTINGS = cases.settings(WINDOW, TWO_COLOURS, {6: -170.0, 8: 40.0, 11: -30.0}).for_single_frames()
MODEL = ImageModel(PsfModel(SETTINGS, (2, 3, 4)))
GOOD = np.ones(WINDOW, bool)
NOISE = NoiseModel(1.0, 1.0)
BRIGHT_E = 1e5


def sensor(good: np.ndarray = GOOD, **limits) -> Focus:
    return Focus(MODEL, good, NOISE, Limits(**limits))


@pytest.fixture(scope="module")
def focus() -> Focus:
    return sensor()


def drawn(wavefronts_nm, flux_e: float = BRIGHT_E, seed: int = 0, reads: int = 1) -> np.ndarray:
    """Images with photon and read noise, (images, rows, columns)."""
    x = torch.as_tensor(np.atleast_2d(wavefronts_nm))
    mean_e = MODEL.psf.images(x).double().clamp_min(0).numpy() * flux_e
    rng = np.random.default_rng(seed)
    return rng.poisson(mean_e) + rng.normal(0, math.sqrt(reads), mean_e.shape)


def anywhere(count: int, focus_nm: float, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-150, 150, (count, 2)), rng.uniform(-focus_nm, focus_nm, count)])


def test_images_and_slopes_are_those_of_the_table():
    table = FocusTable(MODEL.psf, Optics(), Reach((-500.0, 400.0), 300.0))
    images = FocusImages(table)
    for x in anywhere(3, 350.0):
        truth, jacobian = table.images_and_jacobian(torch.as_tensor(x)[None])
        images(*x)
        np.testing.assert_allclose(images.image.reshape(WINDOW), truth[0].numpy(), atol=1e-8)
        for mine, theirs in zip(images.slopes, jacobian[0].numpy(), strict=True):
            np.testing.assert_allclose(mine.reshape(WINDOW), theirs, atol=1e-4 * np.abs(theirs).max())


@pytest.mark.parametrize("flux_e", [1e6, 1e4, 1e3])
def test_it_finds_the_minimum_that_lift_finds_from_the_truth(focus, flux_e):
    truth = anywhere(12, 100.0)
    images = drawn(truth, flux_e)
    found = [focus.measurement(image) for image in images]
    theirs = lift(MODEL, torch.as_tensor(images), torch.as_tensor(GOOD), NOISE, torch.as_tensor(truth))
    value, sigma = (one.numpy() for one in theirs.mode(4))
    assert all(one.valid for one in found)
    np.testing.assert_allclose([one.sigma_nm for one in found], sigma, rtol=0.01)
    assert np.abs([one.defocus_nm for one in found] - value).max() < 0.05 * sigma.min()
    np.testing.assert_allclose([one.chi2_nu for one in found], theirs.chi2_nu.numpy(), atol=0.01)


@pytest.mark.slow
def test_errors_are_as_large_as_stated(focus):
    truth = anywhere(300, 300.0)
    found = [focus.measurement(image) for image in drawn(truth, 3e3)]
    pulls = [(one.defocus_nm - x[2]) / one.sigma_nm for one, x in zip(found, truth, strict=True)]
    # The mean of 300 unit normals is within 3/√300 = 0.17, their scatter within 3/√600 = 0.12 of 1.
    assert abs(np.mean(pulls)) < 0.17
    assert abs(np.std(pulls) - 1) < 0.12


def test_defocus_up_to_900_nm_is_found_without_a_start(focus):
    truth = np.column_stack([*np.zeros((2, 19)), np.linspace(-900, 900, 19)])
    found = [focus.measurement(image) for image in drawn(truth)]
    assert all(one.valid for one in found)
    assert np.abs([one.defocus_nm - x[2] for one, x in zip(found, truth, strict=True)]).max() < 5.0


def test_bad_pixels_do_not_count():
    good = GOOD.copy()
    good[20:22, 18] = False
    image = drawn([0.0, 0.0, 50.0])[0]
    spoilt = image.copy()
    spoilt[20:22, 18] = (np.nan, 1e9)
    assert sensor(good).measurement(spoilt) == sensor(good).measurement(image)
    assert sensor(good).measurement(spoilt).valid


def spoilt(**changes) -> np.ndarray:
    image = drawn([0.0, 0.0, 50.0])[0]
    return image * changes.get("factor", 1.0) + changes.get("add", 0.0)


@pytest.mark.parametrize(
    ("reason", "image"),
    [
        ("not_finite", spoilt(add=np.where(np.arange(40) == 3, np.nan, 0.0))),
        ("saturated", spoilt(add=np.where(np.arange(40) == 3, np.inf, 0.0))),
        ("lost_star", drawn([0.0, 0.0, 50.0], 0.0)[0]),
        ("range", drawn([600.0, 0.0, 50.0])[0]),
        ("range", drawn([0.0, 0.0, 1200.0])[0]),
        ("chi2", spoilt(add=np.where(np.arange(40) == 20, 1500.0, 0.0))),
    ],
    ids=["NaN", "overflow", "no star", "star aside", "too much defocus", "a bright column"],
)
def test_what_cannot_be_used_says_why(focus, reason, image):
    found = focus.measurement(image)
    assert not found.valid
    assert reason in found.reasons


def test_without_diversity_the_sign_is_open_and_the_twin_is_named():
    plain = ImageModel(PsfModel(replace(SETTINGS, known=replace(SETTINGS.known, diversity_nm={})), (2, 3, 4)))
    blind = Focus(plain, GOOD, NOISE)
    mean_e = plain.psf.images(torch.tensor([[0.0, 0.0, 300.0]])).double().clamp_min(0).numpy()[0] * 1e4
    found = blind.measurement(np.random.default_rng(0).poisson(mean_e).astype(float))
    assert "twin" in found.reasons


@pytest.mark.slow
def test_no_faint_image_gives_a_valid_wrong_defocus(focus):
    truth = anywhere(150, 900.0)
    found = [focus.measurement(image) for image in drawn(truth, 400.0)]
    errors = [one.defocus_nm - x[2] for one, x in zip(found, truth, strict=True) if one.valid]
    assert len(errors) > 50
    assert np.abs(errors).max() < 120.0


@pytest.mark.slow
@pytest.mark.parametrize("window", [(48, 48), (48, 40)])
def test_images_read_out_in_another_orientation_are_named_and_those_of_a_halo_are_not(window):
    known = cases.settings(window, TWO_COLOURS, {6: -170.0, 7: 60.0, 8: 50.0, 11: -30.0, 5: 40.0})
    model = ImageModel(PsfModel(known.for_single_frames(), (2, 3, 4)))
    square = Focus(model, np.ones(window, bool), NOISE)
    x = torch.as_tensor(anywhere(12, 400.0, seed=3))
    mean_e = model.psf.images(x).double().clamp_min(0).numpy() * 1e6
    images = np.random.default_rng(4).poisson(mean_e).astype(float)
    others = [images[:, ::-1], images[:, :, ::-1], images[:, ::-1, ::-1]]
    if window[0] == window[1]:
        others += [one.transpose(0, 2, 1) for one in (images, *others)]
    for other in others:
        assert all("mirrored" in square.measurement(image).reasons for image in other)
    blurred = [gaussian_filter(image, 2.5) for image in images]  # unlike the model, and yet upright
    found = [square.measurement(image) for image in blurred]
    assert min(one.misfit for one in found) > 0.1
    assert not any("mirrored" in one.reasons for one in found)
