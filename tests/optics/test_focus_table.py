"""Images of tip, tilt and focus from a table. Truth: the ordinary model with a finer pupil and a wider field,
finite differences of it, and what the Chebyshev series is said to leave out."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import optics_cases as cases

from irlos_pipe.effects import EffectSet, FixedEffect, TipTiltJitter
from irlos_pipe.effects.colour import AtmosphericDispersion, PlateScale
from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.effects.wavefront import NcpaDrift
from irlos_pipe.estimate.lift import lift
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.tabulated import TabulatedModel, tabulated
from irlos_pipe.optics.focus_table import FocusTable, Reach
from irlos_pipe.optics.grids import Optics
from irlos_pipe.optics.psf import PsfModel

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
