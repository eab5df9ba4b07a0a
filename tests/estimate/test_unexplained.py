"""What an image has beside the model. Truth: images moved, spread and spoilt by known amounts."""

import numpy as np
import pytest
from helpers import focus_loop as made
from scipy.ndimage import gaussian_filter

FLUX_E = 2e6


def mean_e(defocus_nm: float = 20.0) -> np.ndarray:
    """An image without noise, to the precision of one with a hundred million electrons."""
    return made.image_e(defocus_nm, 0, flux_e=1e9).astype(float) * (FLUX_E / 1e9)


def noisy(image_e: np.ndarray, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.poisson(np.maximum(image_e, 0)) + rng.normal(0, 1, image_e.shape)


def beside(image_e: np.ndarray):
    return made.calibration().sensor.measurement(image_e).beside


@pytest.mark.parametrize("sigma_px", [0.5, 0.7])
def test_motion_along_one_axis_is_measured_as_half_its_variance(sigma_px):
    moved = gaussian_filter(mean_e(), (0.0, sigma_px), mode="constant")
    kernel = gaussian_filter(np.eye(1, 41, 20)[0], sigma_px)
    variance_px2 = float(kernel @ (np.arange(41) - 20) ** 2)
    assert beside(noisy(moved)).blur_px2 == pytest.approx(variance_px2 / 2, rel=0.25)


def test_light_that_goes_from_the_core_to_the_halo_is_halo():
    image = mean_e()
    spread = 0.9 * image + 0.1 * gaussian_filter(image, 4.0, mode="constant")
    found = beside(noisy(spread))
    assert found.halo == pytest.approx(0.1, abs=0.03)
    assert abs(found.blur_px2) < 0.05


@pytest.mark.parametrize("part", [0.02, 0.1])
def test_what_neither_explains_is_structure_of_that_size(part):
    image, sign = mean_e(), np.where(np.arange(32) % 2, 1.0, -1.0)
    found = beside(noisy(image * (1 + part * sign * sign[:, None])))
    seen = found.rest.structure(found.rest.level)
    assert seen.rest > 5 * seen.sigma
    assert np.sqrt(seen.rest / seen.star) == pytest.approx(part, rel=0.15)


@pytest.mark.parametrize("defocus_nm", [0.0, 300.0, 600.0])
def test_structure_of_speckles_is_the_same_however_wide_the_image_is(defocus_nm):
    light = mean_e(defocus_nm)
    found = []
    for seed in range(8):
        grain = np.random.default_rng([seed, 4]).standard_normal(light.shape)
        speckles = (
            0.004 * np.sqrt(light.clip(0) * light.sum()) * grain
        )  # of light that lies on a constant halo
        beside_it = beside(noisy(light + speckles, seed))
        found.append(beside_it.rest.structure(beside_it.rest.level).rest)
    assert np.sqrt(np.mean(found)) == pytest.approx(0.004, rel=0.15)
