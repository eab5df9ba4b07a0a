"""The Cramér-Rao bound. Truth: Fisher matrices from finite differences of images, and analysis."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.optics_cases import J_AND_H, halo_and_jitter, ncpa_nm, settings, vector

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.sensitivity import cramer_rao_nm
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.optics.psf import PsfModel

NOLLS = (2, 3, 4, 5, 7)
NOISE = NoiseModel(1.3, 9.0)
STEP_NM = 0.1


@pytest.fixture(scope="module")
def model() -> PsfModel:
    return PsfModel(settings(32, J_AND_H[1::3]), NOLLS, dtype=torch.float64)


@pytest.fixture(scope="module")
def wavefronts() -> torch.Tensor:
    return torch.cat([vector(ncpa_nm(seed, 7, 80.0), NOLLS) for seed in (1, 2, 3)])


def bound_by_differences(model, x, flux_e, optics, background_e) -> np.ndarray:
    """Standard errors from the Fisher matrix of modes, flux and background."""

    def image(modes, flux, background):
        return (flux * model.images(modes[None], optics)[0] + background).numpy().ravel()

    columns = [
        (image(x + move, flux_e, background_e) - image(x - move, flux_e, background_e)) / (2 * STEP_NM)
        for move in STEP_NM * torch.eye(len(NOLLS), dtype=torch.float64)
    ]
    columns.append((image(x, 1.01 * flux_e, 0) - image(x, 0.99 * flux_e, 0)) / (0.02 * flux_e))
    columns.append(np.ones_like(columns[0]))
    variance = NOISE.excess_noise_factor * image(x, flux_e, background_e) + NOISE.floor_e2
    jacobian = np.stack(columns, axis=1)
    return np.sqrt(np.diag(np.linalg.inv(jacobian.T @ (jacobian / variance[:, None]))))[: len(NOLLS)]


@pytest.mark.parametrize("background_e", [0.0, 20.0])
@pytest.mark.parametrize("blurred", [False, True])
def test_the_bound_is_the_inverse_of_the_fisher_matrix(model, wavefronts, blurred, background_e):
    effects = halo_and_jitter(model)
    whole = ImageModel(model, effects.held(effects.starts) if blurred else ())
    flux = torch.tensor([1e4, 1e5, 1e6], dtype=torch.float64)
    ours = cramer_rao_nm(whole, wavefronts, flux, NOISE, background_e=background_e).numpy()
    theirs = [
        bound_by_differences(model, x, float(f), whole.optics, background_e)
        for x, f in zip(wavefronts, flux, strict=True)
    ]
    assert ours == pytest.approx(np.array(theirs), rel=1e-4)


@pytest.mark.parametrize(
    ("noise", "flux_e", "gain"), [(NoiseModel(1.0, 1e-9), 1e5, 2.0), (NoiseModel(1e-9, 1e4), 1e4, 4.0)]
)
def test_four_times_the_light_halves_the_error_of_photon_noise_and_quarters_that_of_reads(
    model, wavefronts, noise, flux_e, gain
):
    whole = ImageModel(model)
    faint, bright = (
        cramer_rao_nm(whole, wavefronts, torch.full((3,), flux), noise) for flux in (flux_e, 4 * flux_e)
    )
    assert (faint / bright).numpy() == pytest.approx(gain, rel=1e-3)
