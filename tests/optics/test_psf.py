"""The forward model against an independent, converged calculation.

Truth: HCIPy on a pupil grid eight times finer (tests/helpers/reference_psf.py), the Airy pattern
(analysis), and the shift theorem (analysis).
"""

import numpy as np
import pytest
import torch
from helpers.light_path_derivatives import assert_jacobian, assert_pullback
from helpers.optics_cases import (
    J_AND_H,
    MAS_RAD,
    NARROW_H,
    READ_NOISE,
    SCALE_MAS,
    everything,
    halo_and_jitter,
    ncpa_nm,
    settings,
    shift_nm,
    vector,
)
from helpers.reference_psf import reference
from scipy.special import j1

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.effects import EffectSet
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.calibration_options import LiftOptions
from irlos_pipe.estimate.lift import lift
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import FRAME_PUPIL_SAMPLES

NOLLS = tuple(range(2, 52))
WAVELENGTHS_NM = (1100.0, 1170.0, 1215.3, 1260.0, 1347.7, 1560.0, 1600.0, 1625.7, 1690.0, 1800.0)
CALIBRATION = ncpa_nm(3)
STRONG = ncpa_nm(0) | {4: ncpa_nm(0)[4] + 300}
STRONGER = ncpa_nm(4) | {4: ncpa_nm(4)[4] + 300}
CIRCLE = PupilGeometry(8.0)


def images(case, zernike_nm, nolls=NOLLS, dtype=torch.float32) -> np.ndarray:
    return PsfModel(case, nolls, dtype=dtype).images(vector(zernike_nm, nolls))[0].double().numpy()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("window", "wavelength_nm", "zernike_nm"),
    [
        (64, 1170.0, {}),
        (64, 1600.0, STRONG),
        (51, 1170.0, STRONGER),
        (51, 1600.0, CALIBRATION),
        ((40, 57), 1170.0, CALIBRATION),
        ((40, 57), 1600.0, STRONGER),
    ],
    ids=str,
)
def test_images_agree_with_hcipy_to_1e_4_of_the_peak(window, wavelength_nm, zernike_nm):
    case = settings(window, ((wavelength_nm, 1.0),))
    truth = reference().spectral_image(zernike_nm, case)
    error = images(case, zernike_nm) - truth
    assert np.abs(error).max() <= 1e-4 * truth.max()
    assert abs(error.sum()) <= 1e-4 * truth.sum()


@pytest.mark.slow
def test_a_broad_band_image_agrees_with_hcipy():
    case = settings(64, J_AND_H)
    truth = reference().spectral_image(STRONG, case)
    assert images(case, STRONG) == pytest.approx(truth, abs=1e-4 * truth.max())


def airy(window: int, wavelength_nm: float, pixel_scale_mas: float) -> np.ndarray:
    """Airy pattern of an 8 m circle, integrated over pixels; as a fraction of all light."""
    nodes, weights = np.polynomial.legendre.leggauss(6)
    pixel = pixel_scale_mas * MAS_RAD
    a = (((np.arange(window) - (window - 1) / 2)[:, None] + nodes / 2) * pixel).ravel()
    z = np.maximum(np.pi * 8.0 / (wavelength_nm * 1e-9) * np.hypot(a[:, None], a[None]), 1e-12)
    fine = (np.pi * 16.0) * (2 * j1(z) / z) ** 2 / (wavelength_nm * 1e-9) ** 2 * pixel**2
    return np.einsum("yjxi,j,i->yx", fine.reshape(window, 6, window, 6), weights / 2, weights / 2)


def measured_scale(image: np.ndarray, window: int, wavelength_nm: float) -> float:
    """Scale at which an Airy pattern fits `image`, from its derivative with respect to the scale."""
    step = 1e-4
    low, high = (airy(window, wavelength_nm, SCALE_MAS * (1 + d)) for d in (-step, step))
    slope = (high - low) / (2 * step)
    columns = np.stack([slope.ravel(), airy(window, wavelength_nm, SCALE_MAS).ravel()], axis=1)
    change = np.linalg.lstsq(columns, (image - airy(window, wavelength_nm, SCALE_MAS)).ravel(), rcond=None)[0]
    return 1 + change[0]


@pytest.mark.parametrize("wavelength_nm", WAVELENGTHS_NM)
def test_the_airy_pattern_has_its_size_to_1e_6_at_every_wavelength(wavelength_nm):
    case = settings(48, ((wavelength_nm, 1.0),), {}, geometry=CIRCLE, margin_mas=1000.0)
    image = images(case, {}, (4,), torch.float64)
    assert measured_scale(image, 48, wavelength_nm) == pytest.approx(1, abs=1e-6)


def moved_px(case, noll: int, pixels: int) -> float:
    """Displacement between tilts of -`pixels` and +`pixels`, from what differs after undoing it."""
    shifts = (-pixels, pixels, -pixels - 0.01, -pixels + 0.01)
    before, after, low, high = (
        images(case, CALIBRATION | {2: 0.0, 3: 0.0, noll: shift_nm(s)}, dtype=torch.float64) for s in shifts
    )
    if noll == 3:
        before, after, low, high = before.T, after.T, low.T, high.T
    slope = (high - low)[:, : -2 * pixels] / 0.02
    return 2 * pixels + np.sum(slope * (after[:, 2 * pixels :] - before[:, : -2 * pixels])) / np.sum(slope**2)


@pytest.mark.slow
@pytest.mark.parametrize("wavelength_nm", WAVELENGTHS_NM[::3])
@pytest.mark.parametrize("noll", [2, 3], ids=["x-tilt to columns", "y-tilt to rows"])
def test_a_tilt_moves_the_image_by_its_angle_to_1e_6_at_every_wavelength(noll, wavelength_nm):
    assert moved_px(settings(51, ((wavelength_nm, 1.0),)), noll, 6) == pytest.approx(12, rel=1e-6)


@pytest.mark.parametrize("window", [48, 47, (47, 48)], ids=str)
def test_the_optical_axis_lies_at_the_centre_of_even_and_odd_windows(window):
    image = images(settings(window, diversity={}, geometry=CIRCLE), {}, (4,), torch.float64)
    assert image == pytest.approx(image[::-1, ::-1], abs=1e-12)
    if isinstance(window, int):
        assert image == pytest.approx(airy(window, 1600.0, SCALE_MAS), abs=2e-5 * image.max())


def test_a_window_beyond_the_period_of_the_pupil_grid_is_refused():
    field_mas = 48 * 1.17e-6 / 8.0 / MAS_RAD  # N λ/D
    with pytest.raises(ValueError, match="pupil"):
        PsfModel(
            settings(64, ((1170.0, 1.0),), pupil_samples=48, pixel_scale_mas=1.05 * field_mas / 64), (4,)
        )


# Derivatives of the forward model.
# Truth: finite differences of the images in float64, and automatic differentiation of `PsfModel.images`,
# whose code shares nothing with the hand-written derivatives but the light path.


PSF_JACOBIAN_NOLLS = tuple(range(2, 22))
SPECTRA = {"mono": NARROW_H, "polychromatic": J_AND_H[::2]}
STEP_NM = 0.05


@pytest.fixture(scope="module", params=SPECTRA, ids=str)
def model(request) -> PsfModel:
    return PsfModel(
        settings((24, 21), SPECTRA[request.param], pupil_samples=64, margin_mas=60.0),
        PSF_JACOBIAN_NOLLS,
        dtype=torch.float64,
    )


@pytest.fixture
def wavefronts() -> torch.Tensor:
    return torch.cat([vector(ncpa_nm(seed, 21), PSF_JACOBIAN_NOLLS) for seed in (1, 2)])


@pytest.mark.slow
def test_derivatives_by_modes_and_otf_parameters_are_finite_differences(model, wavefronts):
    effects = halo_and_jitter(model)
    values = effects.starts * 1.1 + 0.05
    steps = 1e-4 * values.abs().clamp_min(1.0)
    assert_jacobian(model, effects, wavefronts, values, steps)
    assert_pullback(model, effects, wavefronts, values)


def test_derivatives_without_otf_factors_are_finite_differences(model, wavefronts):
    none = EffectSet([], model.grids)
    assert_jacobian(model, none, wavefronts, torch.zeros(0), [])
    assert_pullback(model, none, wavefronts, torch.zeros(0))


@pytest.mark.slow
def test_splitting_a_batch_does_not_change_it(model, wavefronts, monkeypatch):
    many = wavefronts.repeat(3, 1)
    together = model.images_and_jacobian(many)
    monkeypatch.setattr("irlos_pipe.optics.psf.CHUNK_ELEMENTS", 1)
    apart = model.images_and_jacobian(many)
    for one, other in zip(together, apart, strict=True):
        assert one.numpy() == pytest.approx(other.numpy(), abs=1e-15)


@pytest.mark.parametrize("noll", [66, 67, 105, 231])
def test_derivatives_of_high_modes_are_finite_differences_whatever_precision_is_asked_for(noll):
    case, nolls = settings((24, 21), NARROW_H, pupil_samples=64), (4, noll)
    x, move = vector({4: 30.0, noll: 5.0}, nolls), vector({noll: STEP_NM}, nolls)
    exact = PsfModel(case, nolls, dtype=torch.float64)
    numeric = (exact.images(x + move) - exact.images(x - move)) / (2 * STEP_NM)
    single = PsfModel(case, nolls, dtype=torch.float32).images_and_jacobian(x)[1][:, 1].double()
    assert float((single - numeric).norm() / numeric.norm()) < 5e-3


# Sampling for single frames.
# Truth: noise-free images of the same light path, sampled three times as finely (convergence).


SPECTRUM = ((1170.0, 0.5), (1625.0, 0.5))
PSF_SETTINGS_NOLLS = (2, 3, 4)


@pytest.mark.slow
def test_the_defocus_of_bright_frames_errs_by_a_hundredth_of_a_nanometre():
    truth_nm = torch.tensor([[20.0, -30.0, defocus] for defocus in (-300.0, 0.0, 300.0)]).double()
    diversity = ncpa_nm(3)
    diversity[6] -= 170.0
    fine = settings(64, SPECTRUM, diversity, pupil_samples=3 * FRAME_PUPIL_SAMPLES)
    images_e = 1e6 * PsfModel(fine, PSF_SETTINGS_NOLLS, dtype=torch.float64).images(truth_nm)
    model = ImageModel(PsfModel(fine.for_single_frames(), PSF_SETTINGS_NOLLS))
    start_nm = truth_nm + 5.0
    found = lift(model, images_e.float(), everything(images_e), READ_NOISE, start_nm, LiftOptions("model"))
    assert np.abs((found.zernike_nm - truth_nm)[:, 2].numpy()).max() < 0.02
    assert found.sigma_nm[:, 2].min() > 0.1
