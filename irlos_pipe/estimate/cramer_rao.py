"""Cramér–Rao bound of an unbiased estimate from one image."""

from __future__ import annotations

import torch

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics.levenberg_marquardt import scaled_inverse


def cramer_rao_nm(
    model: ImageModel,
    modes_nm: torch.Tensor,
    flux_e: torch.Tensor,
    noise: NoiseModel,
    *,
    background_e: float = 0.0,
) -> torch.Tensor:
    """Return the smallest standard errors of the modes with flux and background free, (images, modes) [nm].

    ``σ² = diag((Jᵀ V⁻¹ J)⁻¹)``, the variance V from the noise-free image; the small information
    that V itself carries is left out, as LIFT does not use it.

    Parameters
    ----------
    model : ImageModel
        Without free effect parameters.
    modes_nm : tensor, (images, modes)
    flux_e : tensor, (images,)
    noise : NoiseModel
    background_e : float
        In every pixel.
    """
    flux = flux_e.double()
    image, columns = model.predict_and_jacobian(modes_nm, flux, torch.full_like(flux, background_e))
    image, columns = image.flatten(1), columns.double().flatten(2)
    fisher = (columns / noise.variance_e2(image)[:, None]) @ columns.mT
    covariance = scaled_inverse(fisher.cpu())
    return torch.diagonal(covariance, dim1=1, dim2=2).sqrt()[:, : len(model.psf.nolls)]
