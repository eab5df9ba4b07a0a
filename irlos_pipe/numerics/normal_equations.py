"""Normal equations of a batch of fits: of weighted least squares, and of robust losses by their tangents.

For a robust loss the images are replaced by their tangents, residuals ``r(δ) = r - √w J δ``. The minimum of
this problem takes a few Newton steps, which cost much less than the next Jacobian would. The step that leads
there is what the solver is given, in the guise of normal equations.
"""

import torch

from irlos_pipe.numerics.loss import Loss

TILE = 16  # rows in which matrix products are quick: with 31 of them a product takes twice as long as with 32
FEW = 12  # rows that are quick without padding
NEWTON_STEPS = 2
FRACTIONS = (1.0, 0.5, 0.25)  # parts of a Newton step: where residuals are few it leaps too far


def normal_equations(
    columns: torch.Tensor, residual: torch.Tensor, root: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return gradient (b, p), summed in float64, and Hessian (b, p, p), as precise as the derivatives.

    The Hessian only shapes steps. Derivatives of the images are `columns` (b, p, pixels), the whitened
    `residual` is (b, repeats, pixels), and `root` (b, repeats or 1, pixels) are square roots of the weights.
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


class Linearised:
    """Tangents of a batch of fits, and where they lead.

    The derivatives of the images are `columns` (b, parameters, pixels), the whitened `residual` (b, repeats,
    pixels) and `root` (b, repeats or 1, pixels), square roots of the weights, are float64. The Gaussian prior
    has a `precision` and the parameters an `offset` from its mean, (b, parameters) each.
    """

    def __init__(self, columns, residual, root, loss: Loss, precision, offset):
        self.size = columns.shape[1]
        self.columns = torch.nn.functional.pad(columns, (0, 0, 0, -self.size % TILE))
        if not loss.quadratic:  # the step is only to lead near the minimum
            residual, root = residual.to(columns.dtype), root.to(columns.dtype)
        self.residual, self.root, self.loss = residual, root, loss
        self.precision, self.offset = precision.to(columns.device), offset.to(columns.device)

    def normal_equations(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Gradient (b, p) and Hessian (b, p, p), float64; for a robust loss those of an equivalent problem.

        Equivalent is a quadratic problem with its minimum where the linearised one has it.
        """
        step = torch.zeros_like(self.offset)
        if self.loss.quadratic:
            return self._gradient(self.residual, step), self._hessian(self.residual)
        residual = self.residual
        for _ in range(NEWTON_STEPS):
            hessian = self._hessian(residual)
            ahead = -_solve(hessian, self._gradient(residual, step))
            fraction, residual = self._searched(residual, ahead)
            step = step + fraction * ahead
        return -(hessian @ step[..., None])[..., 0], hessian

    def _searched(self, residual: torch.Tensor, ahead: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Best of a few `FRACTIONS` of a step, (b, 1), and the residuals it leaves."""
        change = (ahead[:, None].to(residual.dtype) @ self.columns[:, : self.size]) * self.root
        tried = (self.loss.value(residual - fraction * change) for fraction in FRACTIONS)
        losses = [loss.sum((1, 2), dtype=torch.float64) for loss in tried]
        best = torch.tensor(FRACTIONS).to(change)[torch.stack(losses).argmin(0)]
        return best[:, None].double(), residual - best[:, None, None] * change

    def _gradient(self, residual: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """Derivative of the loss and the prior after a step, in the precision of the residuals."""
        force = (self.loss.weight(residual) * residual * self.root).sum(1)
        slope = (self.columns[:, : self.size].to(residual.dtype) @ force[..., None])[..., 0]
        return self.precision * (self.offset + step) - slope.double()

    def _hessian(self, residual: torch.Tensor) -> torch.Tensor:
        """In the precision of the images: it shapes steps, not the minimum."""
        weight = (self.loss.curvature(residual) * self.root**2).sum(1)
        products = (self.columns * weight[:, None].to(self.columns.dtype)) @ self.columns.mT
        return products[:, : self.size, : self.size].double() + torch.diag_embed(self.precision)


def _solve(hessian: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
    """``H⁻¹ g`` of a Hessian that may lack information in some direction."""
    scale = torch.diagonal(hessian, dim1=1, dim2=2).clamp_min(1e-300).rsqrt()
    scaled = hessian * scale[:, :, None] * scale[:, None, :]
    scaled = scaled + 1e-6 * torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
    return scale * torch.linalg.solve_ex(scaled, (scale * gradient)[..., None])[0][..., 0]
