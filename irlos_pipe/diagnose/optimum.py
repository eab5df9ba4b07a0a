"""The residual of a fitted model, and what is left of a shape that the fitted parameters cannot imitate.

Everything is in units of the standard error of the mean image. At the optimum the residual is orthogonal
to the derivatives B of the fitted parameters; of another shape D only the part ``D - B(BᵀB)⁻¹BᵀD`` counts.
Priors are rows of B whose data are what the parameters miss of the prior's mean. How uncertain any
projection is comes from its scatter between frames and from the noise of the dark that they share, so the
same numbers hold for photons and for speckles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch

from irlos_pipe.diagnose.cube import Stack, Stacks
from irlos_pipe.diagnose.fitting import Fitted
from irlos_pipe.effects import Effect
from irlos_pipe.estimate.search import frozen


@dataclass(frozen=True)
class Excess:
    """χ² of the mean image beyond what noise leaves there.

    Attributes
    ----------
    chi2 : float
    sigma : float
        Its standard error in the absence of any.
    expected : float
        χ² from noise alone.
    """

    chi2: float
    sigma: float
    expected: float

    @property
    def significance(self) -> float:
        """In standard errors."""
        return self.chi2 / self.sigma

    @property
    def chi2_nu(self) -> float:
        """χ² over its expectation."""
        return (self.chi2 + self.expected) / self.expected


class Optimum:
    """Whitened residual of the mean training images and of their frames.

    Parameters
    ----------
    stack : Stack or Stacks
    fitted : Fitted
    """

    def __init__(self, stack: Stack | Stacks, fitted: Fitted):
        self.stack, self.fitted = stack, fitted
        problem, x = fitted.problem, fitted.x
        self.root = stack.root
        image, columns = problem.predict_and_jacobian(x)
        self.residual = (stack.mean_e - image) * self.root
        precision = problem.prior_precision[0].sqrt()
        design = torch.cat([(columns * self.root).mT, torch.diag(precision)])
        design = design / design.norm(dim=0).clamp_min(1e-300)
        basis = torch.linalg.qr(design)[0]
        self.basis = basis[: len(self.residual)]
        prior = -(x[0] - problem.prior_mean[0]) * precision
        self._unconverged = self.basis.mT @ self.residual + basis[len(self.residual) :].mT @ prior

    @cached_property
    def frozen(self) -> list[list[Effect]]:
        """The effects as fitted for each recording, to try others beside them."""
        problem = self.fitted.problem
        values = self.fitted.effect_values
        return [frozen(part.model.effects, values) for part in problem.parts]

    @property
    def deviations(self) -> torch.Tensor:
        """Of the frames, whitened, (frames, pixels)."""
        return self.stack.deviations

    def project(self, shapes: torch.Tensor) -> torch.Tensor:
        """What is left of whitened shapes (pixels, m)."""
        return shapes - self.basis @ (self.basis.mT @ shapes)

    def norm2(self, shapes: torch.Tensor) -> torch.Tensor:
        """Gram matrix of what is left, priors included, (m, m)."""
        inside = self.basis.mT @ shapes
        return shapes.mT @ shapes - inside.mT @ inside

    def meeting(self, shapes: torch.Tensor) -> torch.Tensor:
        """Scalar products of the residual with what is left of shapes, (m,)."""
        return shapes.mT @ self.residual - (self.basis.mT @ shapes).mT @ self._unconverged

    @cached_property
    def excess(self) -> Excess:
        """χ² beyond noise, the latter from the scatter of the frames and from what they share."""
        left = self.deviations - (self.deviations @ self.basis) @ self.basis.mT
        gram = left @ left.mT / (len(left) - 1)
        frames, shared = self.stack.independent, self.stack.shared
        expected = float(gram.trace() / frames + shared @ (1 - (self.basis**2).sum(1)))
        power = ((gram**2).sum() - gram.trace() ** 2 / (len(left) - 1)) / frames**2
        of_pixels = (left**2).sum(0) / (len(left) - 1) / frames
        power = float(power + 2 * shared @ of_pixels + shared @ shared)
        chi2 = float(self.residual @ self.residual)
        return Excess(chi2 - expected, max(2 * power, 2 * expected) ** 0.5, expected)
