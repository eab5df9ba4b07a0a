"""Normal equations of weighted least squares, for a batch of fits."""

from __future__ import annotations

import torch

TILE = 16  # rows in which matrix products are quick: with 31 of them a product takes twice as long as with 32
FEW = 12  # rows that are quick anyway


def normal_equations(
    columns: torch.Tensor, residual: torch.Tensor, root: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Gradient (b, p), summed in float64, and Hessian (b, p, p), in the precision of the derivatives.

    The Hessian only shapes steps.

    Parameters
    ----------
    columns : tensor, (b, p, pixels)
        Derivatives of the images.
    residual : tensor, (b, repeats, pixels)
        Whitened.
    root : tensor, (b, repeats or 1, pixels)
        Square roots of the weights.
    """
    size = columns.shape[1]
    if residual.shape[1] > 1:  # images that share derivatives, like one image with their mean residual
        weight = (root * root).expand_as(residual).sum(1, keepdim=True)
        force, root = (residual * root).sum(1, keepdim=True), weight.sqrt()
        residual = torch.where(weight > 0, force / root, 0.0)
    columns = columns * root.to(columns.dtype)
    gradient = _sums(columns, residual[:, 0])
    if size > FEW:
        columns = torch.nn.functional.pad(columns, (0, 0, 0, -size % TILE))
    return -gradient, torch.bmm(columns, columns.mT)[:, :size, :size].double()


def _sums(columns: torch.Tensor, residual: torch.Tensor) -> torch.Tensor:
    """Sums over pixels of weighted derivatives times residuals (b, pixels), (b, p), float64.

    Products need no more digits than the derivatives have; a copy of these in float64 would take longer.
    """
    residual = residual.to(columns.dtype)
    if columns.dtype == torch.float64:
        return torch.bmm(columns, residual[..., None])[..., 0]
    return (columns * residual[:, None]).sum(2, dtype=torch.float64)
