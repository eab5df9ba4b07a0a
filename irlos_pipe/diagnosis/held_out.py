"""Models evaluated on frames or pixels that no fit has seen.

What belongs to single frames, tip, tilt, flux and background, is refitted linearly to frames; all else is
frozen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.diagnosis.cube import Stacks
from irlos_pipe.diagnosis.fitted import Fitted


@dataclass(frozen=True)
class Gap:
    """``Σ|measured − predicted| / Σ measured`` of the mean held-out images, or of their held-out pixels.

    Attributes
    ----------
    before, after : float
        With the old and the new model.
    floor : float
        With a perfect model, from noise alone.
    """

    before: float
    after: float
    floor: float

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
    """A model's residuals on the held-out data.

    Parameters
    ----------
    stack : Stacks
        Held out.
    fitted : Fitted
    """

    def __init__(self, stack: Stacks, fitted: Fitted):
        self.stack, self.pixels = stack, fitted.problem.pixels
        self.image, columns = fitted.linearised
        own = columns[fitted.problem.own if stack.own_refitted else []].mT
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
        """See `Gap`."""
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
