"""Cramér–Rao bound of an unbiased estimate from one image."""

from __future__ import annotations

import torch

from ..noise import NoiseModel
from ..psf import PsfModel
from .solve import scaled_inverse


def cramer_rao_nm(
    model: PsfModel,
    coefficients_nm: torch.Tensor,
    flux_e: torch.Tensor,
    noise: NoiseModel,
    *,
    transfer: torch.Tensor | None = None,
    background_e: float = 0.0,
) -> torch.Tensor:
    """Smallest standard errors of the modes with flux and background free, (images, modes) [nm].

    ``σ² = diag((Jᵀ V⁻¹ J)⁻¹)``, the variance V from the noise-free image; the small information
    that V itself carries is left out, as LIFT does not use it.

    Parameters
    ----------
    coefficients_nm : tensor, (images, modes)
    flux_e : tensor, (images,)
    """
    unit, jacobian = model.images_and_jacobian(coefficients_nm, transfer)
    unit, jacobian = unit.double().flatten(1), jacobian.double().flatten(2)
    flux = flux_e.double().to(unit.device)[:, None]
    columns = torch.cat([jacobian * flux[..., None], unit[:, None], torch.ones_like(unit)[:, None]], dim=1)
    fisher = (columns / noise.variance_e2(unit * flux + background_e)[:, None]) @ columns.mT
    covariance = scaled_inverse(fisher)
    return torch.diagonal(covariance, dim1=1, dim2=2).sqrt()[:, : len(model.nolls)].cpu()
