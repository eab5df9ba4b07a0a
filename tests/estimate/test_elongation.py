"""The elongation prior. Truth: synthetic Gaussians, the sign of the astigmatism, images of the model."""

import numpy as np
import pytest
import torch
from helpers import focus_loop as made
from helpers import optics_cases as cases
from helpers.optics_cases import (
    J_AND_H,
    NARROW_H,
    SCALE_MAS,
    draw_frames,
    everything,
    halo_and_jitter,
    ncpa_nm,
    settings,
    vector,
)
from helpers.reference_psf import reference
from scipy.ndimage import gaussian_filter

from irlos_pipe.estimate.calibration import calibrate
from irlos_pipe.estimate.calibration_options import CalibrationOptions
from irlos_pipe.estimate.correction import ALL, strehl_budget
from irlos_pipe.estimate.cube import Frames
from irlos_pipe.estimate.elongation import (
    axis_ratios,
    calibrate_law,
    fit_gaussians,
)
from irlos_pipe.estimate.score_test import Mirrored
from irlos_pipe.frames.noise import NoiseModel
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


# Strehl budget; truth: Maréchal's law, the Gaussian blur of an OTF, and HCIPy's images.


WINDOW, NOLLS = (41, 41), tuple(range(4, 16))
WAVELENGTH_NM = NARROW_H[0][0]


def budget(effects=(), **modes_nm: dict[int, float]):
    parts = {name: vector(one, NOLLS)[0].numpy() for name, one in modes_nm.items()}
    return {
        one.name: one
        for one in strehl_budget(settings(WINDOW), NOLLS, parts, {one.name: one for one in effects})
    }


def test_small_aberrations_follow_marechal_and_multiply():
    found = budget(low={5: 25.0}, high={14: 20.0})
    for name, nm in (("low", 25.0), ("high", 20.0)):
        marechal = np.exp(-((2 * np.pi * nm / WAVELENGTH_NM) ** 2))
        assert found[name].alone == pytest.approx(marechal, abs=2e-3)
        assert found[name].wfe_nm == pytest.approx(nm)
    assert found[ALL].alone == pytest.approx(found["low"].alone * found["high"].alone, abs=1e-3)
    assert found["low"].without == pytest.approx(found["high"].alone)


@pytest.mark.slow
def test_the_strehl_ratio_is_that_of_hcipys_images():
    imager, modes = reference(512), {n: nm for n, nm in ncpa_nm(5, 15, 90.0).items() if n in NOLLS}
    images = [imager.image(opd, WAVELENGTH_NM, WINDOW, SCALE_MAS) for opd in (imager.opd_nm(modes), 0.0)]
    true = images[0].max() / images[1].max()
    assert budget(modes=modes)[ALL].alone == pytest.approx(true, abs=1e-3)


# What an image has beside the model. Truth: images moved, spread and spoilt by known amounts.


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


# Mirrored images are told by the vanes.
# Truth: frames drawn from the model (same code, on purpose: the question is what the vanes tell), mirrored by
# exchanging rows or columns; the scatter of the amplitude over draws of the noise.


ORIENTATION_NOLLS = tuple(range(2, 16))
CHANGES = {
    "as told": lambda images: images,
    "turned by 180°": lambda images: images.flip(1, 2),
    "left to right": lambda images: images.flip(2),
    "up and down": lambda images: images.flip(1),
}


def found(change: str, flux: float = 3e6, seed: int = 5) -> Mirrored:
    true = cases.vector(cases.ncpa_nm(4, highest_noll=15, total_nm=100.0), ORIENTATION_NOLLS)
    image = PsfModel(cases.settings(), ORIENTATION_NOLLS).images(true)[0].double().numpy() * flux
    images = torch.as_tensor(np.ascontiguousarray(CHANGES[change](cases.draw_frames(image, 24, seed=seed))))
    frames = Frames(images, cases.everything(images), NoiseModel(1.0, 1.0))
    options = CalibrationOptions(highest_noll=15, prior=cases.PRIOR)
    result = calibrate(frames, cases.settings(), options).mirrored
    assert result is not None
    return result


@pytest.mark.parametrize(("change", "amplitude"), [*zip(CHANGES, (0.0, 0.0, 1.0, 1.0), strict=True)])
def test_a_mirrored_image_shows_the_mirrored_pupil(change, amplitude):
    """Turned by 180° the vanes of UT4 stay where they are: that is what no image tells."""
    result = found(change)
    assert result.tells and abs(result.amplitude - amplitude) < 5 * result.sigma + 0.1
    assert (result.amplitude > result.limit) == (amplitude == 1.0)


@pytest.mark.slow
def test_the_quoted_error_is_the_scatter_over_draws():
    some = [found("as told", flux=1e5, seed=seed) for seed in range(12)]
    pulls = [one.amplitude / one.sigma for one in some]
    assert 0.5 < np.std(pulls) < 1.7 and abs(np.mean(pulls)) < 1.0
