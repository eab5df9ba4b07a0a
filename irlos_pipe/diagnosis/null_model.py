"""The residual of a fitted model: the null model of score tests, the excess of χ², and what is significant.

Priors are rows of B whose data are what the parameters miss of the prior's mean. How uncertain any projection
is comes from its scatter between frames and from the noise of the dark that they share, so the same numbers
hold for photons and for speckles.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy import special

from irlos_pipe.diagnosis.cube import Stacks
from irlos_pipe.diagnosis.fitting import Fitted
from irlos_pipe.effects import Effect
from irlos_pipe.estimate.score_test import LinearEstimate, NullModel, frozen_effects, orthonormal
from irlos_pipe.optics.psf_settings import PsfSettings

SURE = 25.0  # ln odds from which an effect is named: those of false ones reached 14 in tuning runs
FAR_OFF = 3.0  # χ² over its expectation that no complete model leaves, however much was missing before


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
        precision = problem.prior_precision[0]
        basis, of_priors = orthonormal(columns * root, precision)
        unconverged = basis.mT @ residual - of_priors.mT @ ((x[0] - problem.prior_mean[0]) * precision.sqrt())
        super().__init__(residual, root, basis, unconverged)

    def under(self, stack: Stacks) -> "Optimum":
        """The same model with other variances of the same frames."""
        return self if stack is self.stack else Optimum(stack, self.fitted)

    def change_to(self, other: Fitted) -> torch.Tensor:
        """Whitened change of the image to another model, (pixels,)."""
        return (other.image_e - self.fitted.image_e) * self.root

    def significance_of_change(
        self, other: Fitted, parameters: int, trials: int = 1, misfit: float = 1.0
    ) -> float:
        """Significance of that to a model with so many more `parameters`, against noise or the frames [σ].

        It is the best of `trials`; errors of both models enlarge χ² by `misfit`.
        """
        stack = self.stack
        if stack.photon_limited:
            fall = max((self.fitted.chi2 - other.chi2) / misfit, 0.0)
            return gaussian_sigma(fall, parameters, np.inf, trials)
        change = self.change_to(other)[:, None]
        variance = misfit * stack.covariance_of(self.project(change))[0, 0]
        hotelling = float(self.projection(change)[0] ** 2 / variance.clamp_min(1e-300))
        return gaussian_sigma(hotelling, parameters, stack.independent, trials)

    @property
    def deviations(self) -> torch.Tensor:
        """Deviations of the frames, whitened, (frames, pixels)."""
        return self.stack.deviations

    @cached_property
    def excess(self) -> Excess:
        """χ² beyond noise and the scatter of frames."""
        expected, sigma = self.stack.chance(self.basis)
        return Excess(float(self.residual @ self.residual) - expected, sigma, expected)


MOST_OF_FRAMES = 0.3  # directions of a test over the number of frames, at most
SURELY = 0.95  # probability with which an effect of the smallest detectable size is seen


def significance_of(optimum: FittedModel, linear: LinearEstimate, trials: int) -> tuple[float, float]:
    """Inflation, and Hotelling's T² of the projections over the frames in Gaussian σ, the best of `trials`.

    Frames allow no test in more directions than a part of their number: the leading ones of the normal matrix
    are taken, into which the family's power falls. Directions that the prior holds are left out.
    """
    stack = optimum.stack
    values, vectors = torch.linalg.eigh(linear.normal)
    measured = ((vectors.mT @ linear.gram) * vectors.mT).sum(1) > 0.5 * values
    if not measured.any():
        return 1.0, 0.0
    axes = (vectors / values.sqrt())[:, measured]  # the shapes along them are orthonormal
    if not stack.photon_limited:
        axes = axes[:, -max(1, int(MOST_OF_FRAMES * stack.independent)) :]
    along = axes.mT @ linear.projection
    if stack.photon_limited:
        return 1.0, gaussian_sigma(float(along @ along), len(along), np.inf, trials)
    left = optimum.project(linear.used @ axes, linear.inside @ axes)
    held = axes.mT @ linear.gram @ axes - left.mT @ left  # what priors, not the data, keep parameters from
    covariance = optimum.covariance_of(left) + held
    inflation = float(covariance.diagonal().mean())
    hotelling = float(along @ torch.linalg.solve(covariance, along))
    return inflation, gaussian_sigma(hotelling, len(along), stack.independent, trials)


def gaussian_sigma(hotelling: float, directions: int, frames: float, trials: int = 1) -> float:
    """`hotelling`, the T² of a mean, as the σ of a normal deviate of the same tail probability.

    It has `directions` over `frames`, with infinitely many of which it is χ², and is the best of `trials`.
    """
    if np.isinf(frames):
        tail = _log(special.chdtrc(directions, hotelling))
        # Beyond the range of chdtrc: its leading terms.
        tail = tail if np.isfinite(tail) else -hotelling / 2 + (directions / 2 - 1) * np.log(hotelling / 2)
    else:
        freedom = max(frames - directions, 1.0)  # slow changes leave fewer frames than directions
        scale = directions * (freedom + directions - 1)
        tail = _log_tail_of_f(hotelling * freedom / scale, directions, freedom)
    return float(max(-special.ndtri_exp(min(tail + np.log(trials), np.log(0.5))), 0.0))


def surely_exceeding(limit: float, directions: int) -> float:
    """Noncentrality from which χ² over `directions` exceeds `limit` with the probability `SURELY`.

    It is the λ₀ of the minimal detectable bias (Baarda 1968; Teunissen 2018, 10.1007/s00190-017-1045-7).
    """
    return float(special.chndtrinc(limit, directions, 1 - SURELY))


def _log_tail_of_f(value: float, above: float, below: float) -> float:
    """``ln P(F > value)`` for any number of degrees of freedom.

    F is a ratio of which ``x = below / (below + above F)`` follows a beta law; far out its tail is the
    leading term of the incomplete beta function.
    """
    tail = _log(special.fdtrc(above, below, value))
    if np.isfinite(tail):
        return float(tail)
    x, (a, b) = below / (below + above * value), (below / 2, above / 2)
    return float(a * np.log(x) + (b - 1) * np.log1p(-x) - np.log(a) - special.betaln(a, b))


def _log(probability: float) -> float:
    """Its natural logarithm, −∞ of none."""
    return float(np.log(probability)) if probability > 0 else -np.inf
