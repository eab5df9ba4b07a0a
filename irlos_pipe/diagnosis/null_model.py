"""The residual of a fitted model: the null model of score tests, and the excess of χ².

Priors are rows of B whose data are what the parameters miss of the prior's mean. How uncertain any projection
is comes from its scatter between frames and from the noise of the dark that they share, so the same numbers
hold for photons and for speckles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch

from irlos_pipe.diagnosis.cube import Stacks
from irlos_pipe.diagnosis.fitted import Fitted
from irlos_pipe.effects import Effect
from irlos_pipe.estimate.score_test import NullModel, frozen_effects
from irlos_pipe.optics.psf_settings import PsfSettings


@dataclass(frozen=True)
class Excess:
    """χ² of the mean image beyond what noise leaves there."""

    chi2: float
    sigma: float  # its standard error in the absence of any
    expected: float  # χ² from noise alone

    @property
    def significance(self) -> float:
        """In standard errors."""
        return self.chi2 / self.sigma

    @property
    def chi2_nu(self) -> float:
        """χ² over its expectation."""
        return (self.chi2 + self.expected) / self.expected


class FittedModel(NullModel):
    """The null model of tests jointly with all that a fit has."""

    fitted: Fitted
    stack: Stacks

    def whiten(self, shapes: torch.Tensor) -> torch.Tensor:
        """Whitened shapes (pixels, m)."""
        return shapes * self.root[:, None]

    def covariance_of(self, left: torch.Tensor) -> torch.Tensor:
        """Of products of the mean with whitened shapes (pixels, m), (m, m)."""
        return self.stack.covariance_of(left)

    @property
    def settings(self) -> PsfSettings:
        """Settings of the first recording; the window is that of all."""
        return self.fitted.problem.model.psf.settings

    @cached_property
    def frozen(self) -> list[list[Effect]]:
        """The effects as fitted for each recording, to test others jointly with them."""
        return [
            frozen_effects(part.model.effects, x[0, part.layout.effect_values])
            for part, x in self.fitted.recordings
        ]


class Optimum(FittedModel):
    """Whitened residual of the mean training images and of their frames."""

    def __init__(self, stack: Stacks, fitted: Fitted):
        self.fitted = fitted
        problem, x, root = fitted.problem, fitted.x, stack.root
        image, columns = fitted.linearised
        residual = (stack.mean_e - image) * root
        self.stack = stack.against(residual, len(columns))
        precision = problem.prior_precision[0].sqrt()
        design = torch.cat([(columns * root).mT, torch.diag(precision)])
        design = design / design.norm(dim=0).clamp_min(1e-300)
        whole = torch.linalg.qr(design)[0]
        basis = whole[: len(residual)]
        prior = -(x[0] - problem.prior_mean[0]) * precision
        unconverged = basis.mT @ residual + whole[len(residual) :].mT @ prior
        super().__init__(residual, root, basis, unconverged)

    def under(self, stack: Stacks) -> Optimum:
        """The same model with other variances of the same frames."""
        return self if stack is self.stack else Optimum(stack, self.fitted)

    @property
    def deviations(self) -> torch.Tensor:
        """Deviations of the frames, whitened, (frames, pixels)."""
        return self.stack.deviations

    @cached_property
    def excess(self) -> Excess:
        """χ² beyond noise and the scatter of frames."""
        expected, sigma = self.stack.chance(self.basis)
        return Excess(float(self.residual @ self.residual) - expected, sigma, expected)

    def excess_in(self, moment: int) -> float:
        """χ² beyond noise of the recordings of one `moment`."""
        pairs = zip(self.fitted.views, self.fitted.problem.pixels, strict=True)
        pixels = [at for view, at in pairs if view.moment == moment]
        if len(pixels) == len(self.fitted.views):
            return self.excess.chi2
        chi2 = sum(float(self.residual[at] @ self.residual[at]) for at in pixels)
        share = sum(int((self.root[at] > 0).sum()) for at in pixels) / int((self.root > 0).sum())
        return chi2 - share * self.excess.expected
