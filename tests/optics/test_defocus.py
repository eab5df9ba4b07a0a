"""Images of tip, tilt and focus from a table. Truth: the ordinary model with a finer pupil and a wider field,
finite differences of it, and what the Chebyshev series is said to leave out."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases
from scipy.special import j0, j1

from irlos_pipe.conventions.pupil_drawing import PupilGeometry
from irlos_pipe.effects import EffectSet, FixedEffect, TipTiltJitter
from irlos_pipe.effects.colour import AtmosphericDispersion, PlateScale
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.wavefront import NcpaDrift
from irlos_pipe.estimate.calibration_options import LiftOptions
from irlos_pipe.estimate.lift import lift
from irlos_pipe.estimate.tabulated import TabulatedModel, tabulated
from irlos_pipe.optics.defocus import defocus_nm_per_um, defocus_series
from irlos_pipe.optics.focus_table import FocusTable, Reach
from irlos_pipe.optics.grids import Optics
from irlos_pipe.optics.image_quality import correlations, encircled_energy, power_spectrum, transfer_cut
from irlos_pipe.optics.light_path import AS_BUILT
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings

TTF = (2, 3, 4)
WINDOW = (40, 48)
SETTINGS = cases.settings(WINDOW, cases.J_AND_H, {6: -170.0, 7: 40.0, 11: -50.0, 8: 60.0}).for_single_frames()
REACH = Reach((-500.0, 400.0), 300.0)
STEP_NM = 1.0


def wavefronts(count: int = 5, seed: int = 0) -> torch.Tensor:
    """Anywhere within the reach."""
    rng = np.random.default_rng(seed)
    tilts = rng.uniform(-REACH.tilt_nm, REACH.tilt_nm, (count, 2))
    return torch.as_tensor(np.column_stack([tilts, rng.uniform(*REACH.focus_nm, count)]))


def fine_model(settings=SETTINGS, nolls=TTF) -> PsfModel:
    wider = replace(settings, pupil_samples=128, margin_mas=400.0, halo_margin_mas=900.0)
    return PsfModel(wider, nolls, dtype=torch.float64)


def optics_of(model: PsfModel, *effects) -> Optics:
    return EffectSet(effects, model.grids)()


def largest(difference: torch.Tensor, images: torch.Tensor) -> float:
    """Of the brightest pixel of the typical image."""
    return float(difference.abs().max() / images.amax((1, 2)).median())


@pytest.mark.parametrize(("dtype", "nolls"), [(torch.float32, TTF), (torch.float64, (4, 3, 2))])
def test_images_are_those_of_a_finer_model(dtype, nolls):
    x = wavefronts()
    coarse, fine = PsfModel(SETTINGS, nolls, dtype=dtype), fine_model(nolls=nolls)
    order = [TTF.index(noll) for noll in nolls]
    table, truth = FocusTable(coarse, Optics(), REACH), fine.images(x[:, order])
    assert largest(table.images(x[:, order]) - truth, truth) < 5e-5
    assert largest(table.images_and_jacobian(x[:, order])[0] - truth, truth) < 5e-5


@pytest.mark.parametrize("mode", range(3))
def test_derivatives_are_those_of_the_finer_models_images(mode):
    x, fine = wavefronts(), fine_model()
    step = torch.eye(3, dtype=torch.float64)[mode] * STEP_NM
    truth = (fine.images(x + step) - fine.images(x - step)) / (2 * STEP_NM)
    jacobian = FocusTable(PsfModel(SETTINGS, TTF), Optics(), REACH).images_and_jacobian(x)[1]
    assert (jacobian[:, mode] - truth).abs().max() < 1e-4 * truth.abs().max()


@pytest.mark.slow
def test_effects_are_in_the_table():
    model, fine, x = PsfModel(SETTINGS, TTF), fine_model(), wavefronts()
    held = (
        FixedEffect(TipTiltJitter(), TipTiltJitter().values_of(6.0)),
        FixedEffect(AtmosphericDispersion(), AtmosphericDispersion().values_of(20.0, 30.0)),
        FixedEffect(PlateScale(9.7), [0.02]),
    )
    halo = cases.halo_and_jitter(model).effects[0]
    held += (FixedEffect(halo, [p.start for p in halo.parameters]),)
    table, truth = FocusTable(model, optics_of(model, *held), REACH), fine.images(x, optics_of(fine, *held))
    assert largest(table.images(x) - truth, truth) < 1e-4


def frames(model: ImageModel, modes_nm: torch.Tensor, flux_e: float = 1e6) -> torch.Tensor:
    flux = torch.full((len(modes_nm),), flux_e, dtype=torch.float64)
    mean = model.predict(modes_nm, flux, torch.zeros_like(flux)).clamp_min(0)
    return torch.poisson(mean, generator=torch.Generator().manual_seed(1)).float()


@pytest.mark.parametrize("noise", ["data", "model", "iterative"])
def test_estimates_are_those_of_the_model_that_was_tabulated(noise):
    general, true = ImageModel(PsfModel(SETTINGS, TTF)), 0.4 * wavefronts()
    images, start, options = frames(general, true), torch.zeros_like(true), LiftOptions(noise)
    quick = TabulatedModel(general, REACH)
    one, other = (
        lift(model, images, cases.everything(images), cases.READ_NOISE, start, options)
        for model in (general, quick)
    )
    assert ((one.zernike_nm - other.zernike_nm).abs() < 0.05 * one.sigma_nm).all()
    assert torch.allclose(one.sigma_nm, other.sigma_nm, rtol=1e-3)
    assert one.solution.status == other.solution.status == ["converged"] * len(true)
    assert torch.allclose(one.chi2_nu, other.chi2_nu, rtol=1e-3)


def test_a_frame_beyond_the_reach_is_left_to_the_model_that_was_tabulated():
    general = ImageModel(PsfModel(SETTINGS, TTF))
    true = torch.tensor([[0.0, 20.0, 30.0], [10.0, -30.0, 220.0], [150.0, 0.0, 0.0]], dtype=torch.float64)
    images, start = frames(general, true), 0.8 * true
    arguments = images, cases.everything(images), cases.READ_NOISE, start, LiftOptions("model")
    one = lift(general, *arguments)
    other = lift(TabulatedModel(general, Reach((-150.0, 150.0), 100.0)), *arguments)
    assert torch.allclose(other.zernike_nm, true, atol=3.0)
    assert torch.equal(one.zernike_nm[1:], other.zernike_nm[1:])
    assert ((one.zernike_nm[0] - other.zernike_nm[0]).abs() < 0.05 * one.sigma_nm[0]).all()


def test_what_cannot_be_tabulated_is_left_as_it_is():
    start = torch.zeros(1, 3)
    drift = FixedEffect(NcpaDrift([5]), [10.0])
    coarse_pixels = replace(SETTINGS, pixel_scale_mas=13.0, window=(24, 24))
    models = [
        ImageModel(PsfModel(SETTINGS, (2, 3, 4, 5))),
        ImageModel(PsfModel(SETTINGS, (4, 5, 6))),
        ImageModel(PsfModel(SETTINGS, TTF), [TipTiltJitter()]),
        ImageModel(PsfModel(SETTINGS, TTF), [drift]),
        ImageModel(PsfModel(coarse_pixels, TTF)),
    ]
    assert all(tabulated(model, start) is model for model in models)


# Defocus of high aperture. Truth: the Debye integral by quadrature, and the expansion for small s.


SINE, WAVELENGTH_NM, PIXEL_NM = 0.85, 520.0, 130.0
DIAMETER_M = 2 * SINE  # one metre in front of the focus: 1 nm there is 1e-9 rad
PIXEL_MAS = np.rad2deg(PIXEL_NM * 1e-9) * 3.6e6


def settings(window: int, sine: float = SINE, defocus_nm: float = 0.0) -> PsfSettings:
    known = KnownWavefront(introduced_nm={4: defocus_nm})
    return PsfSettings(
        PupilGeometry(DIAMETER_M, 0.0, ()),
        (window, window),
        PIXEL_MAS,
        ((WAVELENGTH_NM, 1.0),),
        known,
        focus_sine=sine,
    )


def debye_row(z_nm: float, window: int, sine: float = SINE) -> np.ndarray:
    """Middle row of the pixel-integrated image of a point at the distance `z_nm` from the focus."""
    x, w = np.polynomial.legendre.leggauss(400)
    rho, weight = (x + 1) / 2, w / 2 * (x + 1) / 2
    k = 2 * np.pi / WAVELENGTH_NM
    field = weight * np.exp(-1j * k * z_nm * np.sqrt(1 - sine**2 * rho**2))
    inner, share = np.polynomial.legendre.leggauss(6)
    across = (np.arange(window)[:, None] - (window - 1) / 2 + inner / 2) * PIXEL_NM
    radius = np.hypot(across[:, :, None], inner / 2 * PIXEL_NM)
    intensity = np.abs(j0(k * sine * radius[..., None] * rho) @ field) ** 2
    return np.einsum("pij,i,j->p", intensity, share / 2, share / 2)


@pytest.mark.parametrize("z_nm", [0.0, 900.0, -2100.0])
def test_images_agree_with_the_debye_integral(z_nm):
    defocus_nm = z_nm * 1e-3 * defocus_nm_per_um(SINE)
    model = PsfModel(settings(41, defocus_nm=defocus_nm), (4,), dtype=torch.float64)
    row = model.images(torch.zeros(1, 1))[0, 20].numpy()
    truth = debye_row(z_nm, 41)
    truth *= row.sum() / truth.sum()
    assert row == pytest.approx(truth, abs=3e-4 * truth.max())


@pytest.mark.parametrize("sine", [-0.1, 0.99, float("nan")])
def test_an_impossible_sine_is_refused(sine):
    with pytest.raises(ValueError, match="sine of the marginal ray"):
        defocus_series(sine)


def test_derivatives_and_the_table_have_the_same_shape():
    model = PsfModel(settings(31), (2, 3, 4), dtype=torch.float64)
    at = torch.tensor([[5.0, -8.0, 150.0]], dtype=torch.float64)
    image, jacobian = model.images_and_jacobian(at)
    step = torch.tensor([[0.0, 0.0, 1e-3]], dtype=torch.float64)
    numeric = (model.images(at + step) - model.images(at - step)) / 2e-3
    assert jacobian[0, 2].numpy() == pytest.approx(numeric[0].numpy(), abs=1e-6 * float(numeric.abs().max()))
    table = FocusTable(model, AS_BUILT, Reach((-300.0, 300.0), 50.0))
    assert table.images(at).numpy() == pytest.approx(image.numpy(), abs=2e-4 * float(image.max()))


# OTF cuts, encircled energy, power spectra; truth: the Airy pattern, Parseval's theorem, Monte Carlo.


RESOLUTION_PX, SIDE = 8.0, 513  # λ/D, finely sampled, in a wide window
CENTRE = (SIDE - 1) / 2


def airy(offset_px: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Light per pixel of an Airy pattern of unit flux, at points."""
    y, x = np.indices((SIDE, SIDE)) - CENTRE
    v = np.pi * np.hypot(y - offset_px[0], x - offset_px[1]) / RESOLUTION_PX
    v = np.where(v == 0, 1e-9, v)
    return np.pi / 4 / RESOLUTION_PX**2 * (2 * j1(v) / v) ** 2


@pytest.mark.parametrize("axis", [0, 1])
def test_the_otf_of_a_clear_circle_is_the_overlap_of_two_circles(axis):
    found = transfer_cut(airy((3.0, -2.0)), RESOLUTION_PX, axis)
    inside = found.at < 1
    nu = found.at[inside]
    true = 2 / np.pi * (np.arccos(nu) - nu * np.sqrt(1 - nu**2))
    assert found.value[0] == pytest.approx(1)
    np.testing.assert_allclose(found.value[inside], true, atol=0.012)  # 0.8 % of the light lies outside
    assert np.abs(found.value[~inside & (found.at > 1.02)]).max() < 0.002


def test_the_encircled_energy_of_an_airy_pattern_is_rayleighs():
    inner = slice(156, -156)  # what lies farther out changes nothing
    found = encircled_energy(airy((2.25, 1.5))[inner, inner], (CENTRE - 156 + 2.25, CENTRE - 156 + 1.5))
    v = np.pi * found.at / RESOLUTION_PX
    np.testing.assert_allclose(found.value, 1 - j0(v) ** 2 - j1(v) ** 2, atol=0.006)
    assert np.interp(1.22 * RESOLUTION_PX, *found) == pytest.approx(0.838, abs=0.004)


def test_white_noise_has_a_flat_spectrum_whatever_is_masked():
    """Mean of 200 draws; its standard error is below a hundredth in every ring."""
    noise = np.random.default_rng(1).standard_normal((200, 32, 48))
    noise[:, 5:9, 7] = np.nan
    mean = np.mean([power_spectrum(one, 4.0).value for one in noise], axis=0)
    np.testing.assert_allclose(mean, 1.0, atol=0.12)
    assert mean.mean() == pytest.approx(1.0, abs=0.01)


def test_correlations_are_those_of_the_draws():
    covariance = np.array([[4.0, 3.0, 0.0], [3.0, 9.0, 0.0], [0.0, 0.0, 0.0]])
    found = correlations(covariance)
    drawn = np.random.default_rng(0).multivariate_normal([0, 0], covariance[:2, :2], 100_000)
    assert found[0, 1] == pytest.approx(np.corrcoef(drawn.T)[0, 1], abs=0.01)
    assert np.isnan(found[2]).all()
