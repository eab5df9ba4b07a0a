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


def robust_equations(
    columns: torch.Tensor,
    residual: torch.Tensor,
    root: torch.Tensor,
    loss: Loss,
    precision: torch.Tensor,
    offset: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return gradient (b, p) and Hessian (b, p, p), float64, with their minimum where the tangents have it.

    For `columns`, `residual` and `root` see `normal_equations`. The Gaussian prior has a `precision` and the
    parameters an `offset` from its mean, (b, parameters) each. All is in the precision of the derivatives: it
    shapes steps, which are only to lead near the minimum.
    """
    size = columns.shape[1]
    padded = torch.nn.functional.pad(columns, (0, 0, 0, -size % TILE))
    residual, root = residual.to(columns.dtype), root.to(columns.dtype)
    step = torch.zeros_like(offset)
    for _ in range(NEWTON_STEPS):
        weight = (loss.curvature(residual) * root**2).sum(1)
        products = (padded * weight[:, None]) @ padded.mT
        hessian = products[:, :size, :size].double() + torch.diag_embed(precision)
        force = (loss.weight(residual) * residual * root).sum(1)
        slope = (columns @ force[..., None])[..., 0]
        ahead = -_solve(hessian, precision * (offset + step) - slope.double())
        # the best of a few fractions of the step
        change = (ahead[:, None].to(residual.dtype) @ columns) * root
        losses = [loss.value(residual - part * change).sum((1, 2), dtype=torch.float64) for part in FRACTIONS]
        best = torch.tensor(FRACTIONS).to(change)[torch.stack(losses).argmin(0)]
        residual = residual - best[:, None, None] * change
        step = step + best[:, None].double() * ahead
    return -(hessian @ step[..., None])[..., 0], hessian


def _solve(hessian: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
    """``H⁻¹ g`` of a Hessian that may lack information in some direction."""
    scale = torch.diagonal(hessian, dim1=1, dim2=2).clamp_min(1e-300).rsqrt()
    scaled = hessian * scale[:, :, None] * scale[:, None, :]
    scaled = scaled + 1e-6 * torch.eye(hessian.shape[-1], dtype=hessian.dtype, device=hessian.device)
    return scale * torch.linalg.solve_ex(scaled, (scale * gradient)[..., None])[0][..., 0]
