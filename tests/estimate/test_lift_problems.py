"""Fits of noise realisations with the curvature of their frames. Truth: fits with own derivatives."""

from __future__ import annotations

import pytest
import torch
from helpers import optics_cases as cases

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.lift import lift
from irlos_pipe.estimate.lift_options import LiftOptions
from irlos_pipe.estimate.lift_problems import alike
from irlos_pipe.optics.psf import PsfModel

NOLLS, REALISATIONS = (2, 3, 4, 5, 7, 8), 12
FRAMES_NM = torch.tensor([[5.0, -8, 60, 20, -15, 10], [-3.0, 4, -90, -10, 20, 5]]).double()
FRAME = torch.arange(2).repeat(REALISATIONS)
LIMIT = torch.tensor([20.0, 20.0, 40.0, 20.0, 20.0, 20.0]).double()


@pytest.fixture(scope="module")
def model() -> ImageModel:
    effects = cases.halo_and_jitter
    psf = PsfModel(cases.settings(32, cases.J_AND_H[1::3], pupil_samples=64), NOLLS)
    known = effects(psf)
    return ImageModel(psf, known.held(known.starts))


def drawn(model: ImageModel, flux_e: float) -> torch.Tensor:
    flux = torch.full((2,), flux_e).double()
    mean_e = model.predict(FRAMES_NM, flux, torch.zeros(2).double()).numpy()
    realisations = [cases.draw_frames(mean_e[f], 1, seed) for seed, f in enumerate(FRAME.tolist())]
    return torch.cat(realisations)


@pytest.mark.slow
@pytest.mark.parametrize("flux_e", [3e5, 3e3])
@pytest.mark.parametrize("prior", [None, LIMIT])
def test_estimates_are_those_of_fits_with_derivatives_of_their_own(model, flux_e, prior):
    images_e = drawn(model, flux_e)
    near = alike(model, FRAMES_NM + 10.0, FRAME)
    found = [
        lift(
            model,
            images_e,
            cases.everything(images_e),
            cases.READ_NOISE,
            torch.zeros(len(images_e), len(NOLLS)).double(),
            LiftOptions(noise="model", prior_sigma_nm=prior, alike=one),
        )
        for one in (None, near)
    ]
    theirs, ours = found
    assert ours.solution.converged.all()
    assert float(((ours.zernike_nm - theirs.zernike_nm).abs() / theirs.sigma_nm).max()) < 0.1
    assert ours.sigma_nm.numpy() == pytest.approx(theirs.sigma_nm.numpy(), rel=0.3)
