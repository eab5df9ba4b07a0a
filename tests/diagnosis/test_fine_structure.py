"""Structure beyond the cut-off of the telescope.

Truth: HCIPy's images, what was put into the frames, Monte Carlo, and D/λ by hand.
"""

import numpy as np
import pytest
import torch
from helpers.diagnose_cases import CASE, FLUX_E, WAVELENGTH_NM, WINDOW, opd_nm, plain, reference
from helpers.optics_cases import READ_NOISE, draw_frames, everything

from irlos_pipe.diagnosis.checks import (
    Beyond,
    FineStructure,
    highest_frequency_per_px,
    structure_of,
)
from irlos_pipe.diagnosis.cube import Stack
from irlos_pipe.estimate.cube import Frames

FRAMES = 40


def found(images_e: torch.Tensor, mask: torch.Tensor, expected_e: np.ndarray, case=CASE) -> FineStructure:
    """In frames of which a model expects a mean image."""
    stack = Stack.of(Frames(images_e, mask, READ_NOISE), np.linspace(0, 1, len(images_e)))
    return structure_of(stack, torch.as_tensor(expected_e.ravel()), case)


def drawn(mean_e: np.ndarray, seed: int, frames: int = FRAMES) -> tuple[torch.Tensor, torch.Tensor]:
    images = draw_frames(mean_e, frames, seed=seed)
    return images, everything(images)


@pytest.mark.slow
def test_the_image_of_a_telescope_has_nothing_beyond_the_cut_off():
    image = torch.as_tensor(plain())[None]
    mask = torch.ones(CASE.window, dtype=torch.bool)
    beyond, within = (Beyond(mask, part * highest_frequency_per_px(CASE)) for part in (1.0, 0.5))
    assert float(beyond(image).abs().max()) < 2e-5 * float(image.max())
    assert float(within(image).abs().max()) > 2e-3 * float(image.max())


def test_the_cut_off_is_that_of_the_aperture():
    """D/λ by hand: 8 m, 1600 nm, 9.7 mas."""
    assert highest_frequency_per_px(CASE) == pytest.approx(8.0 / 1600e-9 * 9.7e-3 / 206264.806, rel=1e-6)


@pytest.mark.slow
def test_noise_alone_is_not_significant():
    expected = plain() * FLUX_E
    significances = [found(*drawn(expected, seed), expected).significance for seed in range(30)]
    assert max(significances) < 4.5
    assert abs(np.mean(significances)) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("frames", [6, 10, 18])
def test_the_significance_of_few_frames_is_that_of_a_gaussian(frames):
    """Monte Carlo, 100 recordings of noise: one in 740 is beyond 3 σ, and their scatter is 1."""
    expected = plain() * FLUX_E
    drawings = (drawn(expected, 100 + seed, frames) for seed in range(100))
    significances = [found(*drawing, expected).significance for drawing in drawings]
    assert max(significances) < 4.0
    assert 0.7 < np.std(significances) < 1.35


@pytest.mark.slow
@pytest.mark.parametrize("frames", [18, FRAMES])
def test_an_error_of_the_flat_of_one_percent_is_seen(frames):
    expected = plain() * FLUX_E
    gain = 1 + 0.01 * np.random.default_rng(1).standard_normal(expected.shape)
    assert found(*drawn(expected * gain, 2, frames), expected).significance > 5


def test_a_wrong_wavefront_is_no_fine_structure():
    imager = reference()
    other = imager.image(opd_nm(imager, x_px=0.2), WAVELENGTH_NM, CASE.window, 9.7) * FLUX_E
    assert abs(found(*drawn(other, 3), plain() * FLUX_E).significance) < 4.5


def test_what_only_the_model_has_beyond_the_cut_off_is_no_fine_structure():
    """A response that is not linear, in the model or in the data: its square reaches to twice the cut-off."""
    linear = plain() * FLUX_E
    bent = linear * (1 - 0.1 * linear / linear.max())
    assert found(*drawn(bent, 6), linear).significance > 5
    assert abs(found(*drawn(linear, 6), bent).significance) < 4.5
    assert abs(found(*drawn(bent, 6), bent).significance) < 4.5


def test_masked_pixels_do_not_pass_for_structure():
    expected = plain() * FLUX_E
    images, mask = drawn(expected, 4)
    mask = mask.clone()
    mask[WINDOW // 2, WINDOW // 2 + 3], mask[10, 12] = False, False
    images[:, ~mask] = 0.0
    assert abs(found(images, mask, expected).significance) < 4.5
