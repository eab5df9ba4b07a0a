"""Models evaluated on frames or pixels that no fit has seen, and which other names these allow.

What belongs to single frames, tip, tilt, flux and background, is refitted linearly to frames; all else is
frozen.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.diagnosis.cube import Stacks
from irlos_pipe.diagnosis.fitted import Fitted
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.records import Alternative
from irlos_pipe.diagnosis.refit import CLEARLY_LESS, EXPLAINS_AS_MUCH, Refit


@dataclass(frozen=True)
class Gap:
    """``Σ|measured − predicted| / Σ measured`` of the mean held-out images, or of their held-out pixels."""

    before: float  # with the old model
    after: float  # with the new model
    floor: float  # with a perfect model, from noise alone

    @property
    def shrink(self) -> float:
        """Part of the gap above the floor that the new model closes; NaN where there was none."""
        open_ = self.before - self.floor
        return (self.before - self.after) / open_ if open_ > 0 else float("nan")

    @property
    def closed(self) -> float:
        """The same of the squares, in which noise and what a model misses add; NaN where there was none."""
        open_ = self.before**2 - self.floor**2
        return (self.before**2 - self.after**2) / open_ if open_ > 0 else float("nan")


class HeldOutEvaluation:
    """A model's residuals on the held-out data."""

    def __init__(self, stack: Stacks, fitted: Fitted):
        self.stack, self.pixels = stack, fitted.problem.pixels
        self.image, columns = fitted.linearised
        own = columns[fitted.problem.of_recordings if stack.own_refitted else []].mT
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
    def losses(self) -> np.ndarray:
        """Half of χ² of every frame or patch of pixels, (frames or patches,)."""
        pairs = zip(self.stack.parts, self.pixels, strict=True)
        return np.concatenate([part.losses(self.image[at], self.basis[at]) for part, at in pairs])


def preference(better: HeldOutEvaluation, worse: HeldOutEvaluation) -> float:
    """Vuong's statistic for `better` against `worse`: mean difference of the losses over its error."""
    difference = worse.losses - better.losses
    error = difference.std(ddof=1) / np.sqrt(better.stack.independent)
    return float(difference.mean() / error) if error > 0 else 0.0


def noise_floor(judge: HeldOutEvaluation) -> float:
    """What noise alone leaves of the gap: a normal deviate is √(2/π) σ away from zero on average.

    What frames differ by in pointing, flux and background is no noise: it is refitted.
    """
    stack = judge.stack
    good = stack.root > 0
    noise_e = stack.noise_e(judge.basis)[good].sum()
    return float(np.sqrt(2 / np.pi) * noise_e / stack.mean_e[good].sum())


def gap_between(before: HeldOutEvaluation, after: HeldOutEvaluation) -> Gap:
    """Gaps of the models `before` and `after` on the same frames."""
    return Gap(before.gap, after.gap, noise_floor(before))


SURE = 3.0  # Vuong's statistic from which held-out frames decide between two names
LIKENESS = 0.9  # |cos| from which two effects are degenerate in the image
LARGEST_SET = 3  # names not distinguished from the best that are listed, with it


def alternatives(ranked: Sequence[Refit], judges: Sequence[HeldOutEvaluation]) -> list[Alternative]:
    """Names that are not significantly worse than the first of `ranked`.

    `judges`: the evaluation of each on the held-out frames.
    """
    best = ranked[0]
    found = []
    for other, judge in zip(ranked[1:], judges[1:], strict=True):
        z = preference(judges[0], judge)
        deficit = (other.fitted.chi2 - best.fitted.chi2) / best.score.inflation
        if deficit < CLEARLY_LESS or (z < SURE and other.gain > EXPLAINS_AS_MUCH * best.gain):
            found.append(_alternative(best, other, z))
    return sorted(found, key=lambda one: -one.likeness)[: LARGEST_SET - 1]


def likeness(one: Fitted, other: Fitted, before: Optimum) -> float:
    """|cos| of the changes of the image that models `one` and `other` make.

    They are projected off the fitted parameters of the model `before`.
    """
    changes = torch.stack(
        [(fitted.image_e - before.fitted.image_e) * before.root for fitted in (one, other)], dim=1
    )
    gram = before.norm2(changes)
    return float(gram[0, 1].abs() / (gram[0, 0] * gram[1, 1]).clamp_min(1e-300).sqrt())


def _alternative(best: Refit, other: Refit, z: float) -> Alternative:
    cosine = likeness(best.fitted, other.fitted, best.origin)
    alike = "they change the image alike" if cosine > LIKENESS else "both explain the excess as well"
    reason = f"{alike} (|cos| {cosine:.3f}), and the held-out frames do not decide (z {z:.1f})"
    return Alternative(other.name, reason, best.base.look_alike, cosine)
