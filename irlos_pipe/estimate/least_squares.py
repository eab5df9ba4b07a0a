"""Normal equations of weighted least squares, for a batch of fits."""

from __future__ import annotations

import torch

TILE = 16  # rows in which matrix products are quick: with 31 of them a product takes twice as long as with 32
FEW = 12  # rows that are quick anyway


def normal_equations(
    columns: torch.Tensor, residual: torch.Tensor, root: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Gradient (b, p), exact, and Hessian (b, p, p), in the precision of the images: it only shapes steps.

    Parameters
    ----------
    columns : tensor, (b, p, pixels)
        Derivatives of the images.
    residual : tensor, (b, repeats, pixels)
        Whitened, float64.
    root : tensor, (b, repeats or 1, pixels)
        Square roots of the weights, float64.
    """
    size = columns.shape[1]
    gradient = torch.bmm(columns.double(), (residual * root).sum(1)[..., None])[..., 0]
    if size > FEW:
        columns = torch.nn.functional.pad(columns, (0, 0, 0, -size % TILE))
    weight = (root * root).expand_as(residual).sum(1, keepdim=True).to(columns.dtype)
    return -gradient, torch.bmm(columns * weight, columns.mT)[:, :size, :size].double()
