"""What the solvers minimise: batches of problems, of which they know no more than this."""

from abc import ABC, abstractmethod
from typing import Protocol

import torch

CHI2_TOLERANCE = 1e-3  # fall of χ² that no longer matters, in units of χ²/ν where the model misfits
ROUNDING = 1e-6  # relative rounding of an objective whose images are propagated in float32


class Descent(Protocol):
    """A batch of minimisations by exact gradients; `which` selects members of the batch."""

    device: str  # where the solver works; tensors are there, and on the CPU where `solve` does

    def negligible(self, value: torch.Tensor) -> torch.Tensor:
        """Return the predicted fall of the objective at which a member with this `value` is done, (b,)."""

    def gradient(self, x: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the objective (b,) and gradient (b, p) at `x`, float64, of the members `which`."""


class Problem(ABC):
    """A batch of least-squares problems; `which` selects members of the batch."""

    lower: torch.Tensor  # bounds of the parameters, (p,) or (batch, p)
    upper: torch.Tensor
    # whether the equations are those of a re-weighted problem, whose quadratic model does not predict the
    # fall of the objective
    reweighted: bool = False
    confined: bool = False  # whether a member that reaches a bound of its parameters is lost
    same_unit: slice = slice(0)  # parameters that have the same unit, so that their curvatures compare

    @abstractmethod
    def negligible(self, value: torch.Tensor) -> torch.Tensor:
        """Return the predicted fall of twice the objective at which a member with `value` is done, (b,)."""

    @abstractmethod
    def normal_equations(
        self, x: torch.Tensor, which: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Objective (b,), gradient (b, p) and Hessian (b, p, p) at `x` of the members `which`, float64."""

    @abstractmethod
    def objective(self, x: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        """Objective (b,) at `x`, comparable with that of `normal_equations` of the same members `which`."""


class CheapGradientProblem(Problem):
    """A problem whose gradient costs a small part of its normal equations, which may have a rough one."""

    def cheap_gradient(self, x: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the objective and gradient of `normal_equations` at `x` of the members `which`: autograd."""
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            value = self.objective(x, which)
            return value.detach(), torch.autograd.grad(value.sum(), x)[0]
