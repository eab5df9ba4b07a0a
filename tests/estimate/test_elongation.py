"""The elongation prior. Truth: synthetic Gaussians, the sign of the astigmatism, images of the model."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.optics_cases import J_AND_H, draw_frames, everything, halo_and_jitter, settings, vector

from irlos_pipe.estimate.elongation import (
    axis_ratios,
    calibrate_law,
    diversity_angle_deg,
    fit_gaussians,
)
from irlos_pipe.optics.psf import PsfModel


def gaussian(
    first_px: float, second_px: float, angle_deg: float, x0: float = 1.3, y0: float = -2.1
) -> torch.Tensor:
    """Elliptical Gaussian, first axis `angle_deg` from +x towards +y, (1, 40, 36)."""
    y, x = np.indices((40, 36)) - np.array([19.5, 17.5])[:, None, None]
    angle = np.deg2rad(angle_deg)
    u = (x - x0) * np.cos(angle) + (y - y0) * np.sin(angle)
    v = (y - y0) * np.cos(angle) - (x - x0) * np.sin(angle)
    return torch.as_tensor(500 * np.exp(-0.5 * (u / first_px) ** 2 - 0.5 * (v / second_px) ** 2) + 20)[None]


@pytest.mark.parametrize("angle_deg", [0.0, 20.0, 45.0])
@pytest.mark.parametrize(("first_px", "second_px"), [(3.0, 2.0), (2.0, 4.0), (2.5, 2.5)])
def test_the_ratio_of_a_gaussian_s_axes_is_recovered(first_px, second_px, angle_deg):
    image = gaussian(first_px, second_px, angle_deg)
    fit = fit_gaussians(image, everything(image), angle_deg)
    ratio = axis_ratios(image, everything(image), angle_deg)
    assert ratio == pytest.approx([first_px / second_px], rel=1e-3)
    assert fit.values[0, :2].numpy() == pytest.approx([1.3, -2.1], abs=1e-3)


def test_a_frame_of_nan_has_no_ratio_and_leaves_the_others_alone():
    images = gaussian(3.0, 2.0, 0.0).repeat(2, 1, 1)
    images[0, 3, 3] = float("nan")
    ratio = axis_ratios(images, everything(images), 0.0)
    assert np.isnan(ratio[0]) and ratio[1] == pytest.approx(1.5, rel=1e-3)
    assert fit_gaussians(images, everything(images), 0.0).status[0] == "invalid"


@pytest.mark.parametrize(
    ("diversity", "angle_deg"),
    [({6: -170.0}, 0), ({6: 170.0}, 0), ({5: 100.0}, 45), ({5: -100.0}, 45), ({5: 50.0, 6: 50.0}, 22.5)],
)
def test_the_axes_are_those_of_the_diversity(diversity, angle_deg):
    assert diversity_angle_deg(diversity) % 90 == pytest.approx(angle_deg)


@pytest.mark.parametrize(
    "diversity", [{6: -170.0}, {6: 170.0}, {5: -170.0}, {5: 170.0}, {5: 120.0, 6: 120.0}], ids=str
)
def test_the_law_gives_the_defocus_of_images_within_its_range(diversity):
    model = PsfModel(settings(64, J_AND_H[1::3], diversity), (4,))
    law = calibrate_law(model)
    assert law.valid_nm[1] >= 150
    defocus = np.linspace(0.9 * law.valid_nm[0], 0.9 * law.valid_nm[1], 9)
    images = model.images(torch.as_tensor(defocus)[:, None])
    ratio = axis_ratios(images, everything(images), law.angle_deg)
    assert np.abs(law.defocus_nm(ratio) - defocus).max() < 65


@pytest.mark.slow
def test_the_law_holds_with_residual_noise_and_another_star_position():
    case = settings(64, J_AND_H[1::3])
    own = PsfModel(case, (4,))
    effects = halo_and_jitter(own)
    law = calibrate_law(own, effects(effects.starts))
    model = PsfModel(case, (2, 3, 4))
    true = np.array([-150.0, -50.0, 50.0, 150.0])
    wavefronts = torch.cat([vector({2: 60.0, 3: -40.0, 4: nm}, (2, 3, 4)) for nm in true])
    means = model.images(wavefronts, effects(effects.starts)).double().numpy() * 5e4
    frames = torch.cat([draw_frames(mean, 1, seed) for seed, mean in enumerate(means)])
    ratio = axis_ratios(frames, everything(frames), law.angle_deg)
    assert np.abs(law.defocus_nm(ratio) - true).max() < 80
    assert np.all(np.diff(law.defocus_nm(ratio)) > 0)
