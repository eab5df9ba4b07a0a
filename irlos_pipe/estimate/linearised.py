"""A fit with its images replaced by their tangents: residuals ``r(δ) = r - √w J δ``.

For a robust loss the minimum of this problem takes a few Newton steps, which cost much less than the next
Jacobian would. The step that leads there is what the solver is given, in the guise of normal equations.
"""

from __future__ import annotations

import torch

from .loss import Loss

NEWTON_STEPS = 2
FRACTIONS = (1.0, 0.5, 0.25)  # of a Newton step: where residuals are few it leaps too far
TILE = 16  # rows in which matrix products are quick: with 31 of them a product takes twice as long as with 32


class Linearised:
    """Tangents of a batch of fits, ``(b, parameters, pixels)``, and where they lead.

    Parameters
    ----------
    columns : tensor, (b, parameters, pixels)
        Derivatives of the images.
    residual : tensor, (b, repeats, pixels)
        Whitened, float64.
    root : tensor, (b, repeats or 1, pixels)
        Square roots of the weights, float64.
    loss : Loss
    precision, offset : tensor, (b, parameters)
        Of the Gaussian prior, and how far the parameters are from its mean.
    """

    def __init__(self, columns, residual, root, loss: Loss, precision, offset):
        self.size = columns.shape[1]
        self.columns = torch.nn.functional.pad(columns, (0, 0, 0, -self.size % TILE))
        self.residual, self.root, self.loss = residual, root, loss
        self.precision, self.offset = precision.to(columns.device), offset.to(columns.device)

    def normal_equations(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient (b, p) and Hessian (b, p, p), float64; for a robust loss those of an equivalent problem.

        Equivalent is a quadratic problem with its minimum where the linearised one has it.
        """
        step = torch.zeros_like(self.offset)
        if self.loss.quadratic:
            return self._derivatives(self.residual, step)
        residual = self.residual.to(self.columns.dtype)
        self.root = self.root.to(self.columns.dtype)
        for _ in range(NEWTON_STEPS):
            gradient, hessian = self._derivatives(residual, step)
            ahead = -_solve(hessian, gradient)
            fraction, residual = self._searched(residual, ahead)
            step = step + fraction * ahead
        return -(hessian @ step[..., None])[..., 0], hessian

    def _searched(self, residual: torch.Tensor, ahead: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Best of a few `FRACTIONS` of a step, (b, 1), and the residuals it leaves."""
        change = (ahead[:, None].to(self.columns.dtype) @ self.columns[:, : self.size]) * self.root
        losses = [self.loss.value(residual - fraction * change).sum((1, 2), dtype=torch.float64) for fraction in FRACTIONS]
        best = torch.tensor(FRACTIONS, device=change.device, dtype=torch.float64)[torch.stack(losses).argmin(0)]
        return best[:, None], residual - best[:, None, None].to(change.dtype) * change

    def _derivatives(self, residual: torch.Tensor, step: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient, exact, and Hessian, in the precision of the images: it shapes steps, not the minimum."""
        force = (self.loss.weight(residual) * residual * self.root).sum(1)
        if self.loss.quadratic:
            gradient = (self.columns[:, : self.size].double() @ force[..., None])[..., 0]
        else:
            gradient = (self.columns[:, : self.size] @ force[..., None])[..., 0].double()
        weight = (self.loss.curvature(residual) * self.root**2).sum(1)
        products = (self.columns * weight[:, None].to(self.columns.dtype)) @ self.columns.mT
        hessian = products[:, : self.size, : self.size].double() + torch.diag_embed(self.precision)
        return self.precision * (self.offset + step) - gradient, hessian


def _solve(hessian: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
    """``H⁻¹ g`` of a Hessian that may lack information in some direction."""
    scale = torch.diagonal(hessian, dim1=1, dim2=2).clamp_min(1e-300).rsqrt()
    scaled = hessian * scale[:, :, None] * scale[:, None, :]
    scaled = scaled + 1e-6 * torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
    return scale * torch.linalg.solve_ex(scaled, (scale * gradient)[..., None])[0][..., 0]
