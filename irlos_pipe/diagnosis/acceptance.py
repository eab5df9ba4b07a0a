"""Models with and without an effect, compared also by frames or pixels that no fit has seen.

What belongs to single frames, tip, tilt, flux and background, is refitted linearly to frames; all else is
frozen.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from irlos_pipe.diagnosis.checks import Drift
from irlos_pipe.diagnosis.cube import Stacks
from irlos_pipe.diagnosis.fitting import Fitted
from irlos_pipe.diagnosis.null_model import Excess, Optimum
from irlos_pipe.diagnosis.records import Alternative, Gap, Ranked
from irlos_pipe.diagnosis.scores import Score
from irlos_pipe.effects import Effect

DECIDED = 3.0  # Vuong's statistic from which held-out data decide between two models


class HeldOutEvaluation:
    """A model's residuals on the held-out data."""

    def __init__(self, stack: Stacks, fitted: Fitted):
        self.stack, self.pixels = stack, fitted.problem.pixels
        self.image, columns = fitted.linearised
        recordings = range(len(fitted.problem.parts) if stack.held_out == "frames" else 0)
        own = columns[[column for number in recordings for column in fitted.problem.own_of(number)]].mT
        root = stack.root[:, None]
        self.basis, triangle = torch.linalg.qr(own * root)
        self.moves = own @ torch.linalg.inv(triangle)

    @property
    def mean_e(self) -> torch.Tensor:
        """Prediction of the mean images, (pixels,)."""
        residual = (self.stack.mean_e - self.image) * self.stack.root
        return self.image + self.moves @ (self.basis.mT @ residual)

    @property
    def gap(self) -> float:
        good = self.stack.root > 0
        return float((self.stack.mean_e - self.mean_e)[good].abs().sum() / self.stack.mean_e[good].sum())

    @property
    def floor(self) -> float:
        """What noise alone leaves of the gap: a normal deviate is √(2/π) σ away from zero on average.

        What frames differ by in pointing, flux and background is no noise: it is refitted.
        """
        good = self.stack.root > 0
        noise_e = self.stack.noise_e(self.basis)[good].sum()
        return float(np.sqrt(2 / np.pi) * noise_e / self.stack.mean_e[good].sum())

    @property
    def losses(self) -> np.ndarray:
        """Half of χ² of every frame or patch of pixels, (frames or patches,)."""
        pairs = zip(self.stack.parts, self.pixels, strict=True)
        return np.concatenate([part.losses(self.image[at], self.basis[at]) for part, at in pairs])


def preference(stack: Stacks, better: Fitted, worse: Fitted) -> float:
    """Vuong's statistic for the model `better` on held-out data: mean difference of losses over its error."""
    difference = HeldOutEvaluation(stack, worse).losses - HeldOutEvaluation(stack, better).losses
    error = difference.std(ddof=1) / np.sqrt(stack.independent)
    return float(difference.mean() / error) if error > 0 else 0.0


def gap_between(stack: Stacks, before: Fitted, after: Fitted) -> Gap:
    """Gaps of the models `before` and `after` on the same held-out data."""
    old = HeldOutEvaluation(stack, before)
    return Gap(old.gap, HeldOutEvaluation(stack, after).gap, old.floor)


def likeness(one: Fitted, other: Fitted, before: Optimum) -> float:
    """|cos| of the changes of the image that models `one` and `other` make.

    They are projected off the fitted parameters of the model `before`.
    """
    gram = before.norm2(torch.stack([before.change_to(fitted) for fitted in (one, other)], dim=1))
    return float(gram[0, 1].abs() / (gram[0, 0] * gram[1, 1]).clamp_min(1e-300).sqrt())


@dataclass(frozen=True, eq=False)
class Comparison:
    """The model with an effect beside that without it."""

    origin: Optimum  # without it
    fitted: Fitted  # with it
    label: str  # of the effect in the model
    significance: float  # in Gaussian σ

    @property
    def effect(self) -> Effect:
        return self.fitted.effect(self.label)

    @property
    def base(self) -> Effect:
        return self.effect.base

    @property
    def name(self) -> str:
        return self.effect.name

    @property
    def values(self) -> np.ndarray:
        return self.fitted.values_of(self.label)

    @property
    def gain(self) -> float:
        """Fall of χ²."""
        return self.origin.fitted.chi2 - self.fitted.chi2

    @cached_property
    def explained(self) -> float:
        """Part of the excess that there is without the effect."""
        before, after = self.origin.excess, Optimum(self.origin.stack, self.fitted).excess
        return (before.chi2 - after.chi2) / max(before.chi2, self.gain)

    @property
    def ordinary(self) -> bool:
        """Whether as much of it is to be expected anywhere."""
        return self.base.ordinary(self.values)


@dataclass(frozen=True, eq=False)
class Accepted(Comparison):
    """A name, and how it compared."""

    preference: float  # Vuong's statistic on the held-out frames, against the model without it
    gap: Gap  # on the held-out frames, of the models without and with it
    alternatives: Sequence[Alternative] = ()
    ranking: Sequence[Ranked] = ()
    rivals: Sequence[Comparison] = ()  # fits of the alternatives


@dataclass(frozen=True)
class Search:
    """What a search found."""

    null: Optimum  # before all names
    final: Optimum  # with all names
    drift: Drift | None  # None where the model has one already
    accepted: list[Accepted]  # names, the drift not among them
    scores: list[Score]  # of all families, at the last model for which a name was looked for
    meaningless: list[str]  # effects that mean nothing for this cube
    # Effects of the final model that make it fit better and are not sure enough to be named.
    adjusted: Sequence[str] = ()
    nearest: Accepted | None = None  # what comes nearest to a name, where there is none
    # Whether everything was free, as something was missing.
    tolerant: bool = False

    @cached_property
    def remaining(self) -> Excess:
        """What the final model leaves besides noise and the error of the flat, which shows by itself."""
        stack = self.final.stack.without_model_error().limited_by(self.null.stack.photon_limited)
        return self.final.under(stack).excess
