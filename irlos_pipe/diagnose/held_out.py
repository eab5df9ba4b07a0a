"""Models evaluated on frames that no fit has seen.

What belongs to single frames, tip, tilt, flux and background, is refitted linearly; all else is frozen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.diagnose.cube import Stack, Stacks
from irlos_pipe.diagnose.fitting import Fitted


@dataclass(frozen=True)
class Gap:
    """``Σ|measured − predicted| / Σ measured`` of the mean held-out images.

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


class HeldOutEvaluation:
    """A model's residuals on the held-out frames.

    Parameters
    ----------
    stack : Stacks
        Of the held-out frames.
    fitted : Fitted
    """

    def __init__(self, stack: Stacks, fitted: Fitted):
        self.stack, self.pixels = stack, fitted.problem.pixels
        self.image, columns = fitted.problem.predict_and_jacobian(fitted.x)
        own = columns[fitted.problem.own].mT
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
        """Half of χ² of every frame, (frames,)."""
        pairs = zip(self.stack.parts, self.pixels, strict=True)
        return np.concatenate([self._losses(stack, pixels) for stack, pixels in pairs])

    def _losses(self, stack: Stack, pixels: slice) -> np.ndarray:
        """Losses of the frames of one recording."""
        images, basis = stack.frames.images_e.double().flatten(1), self.basis[pixels]
        residual = torch.where(stack.root > 0, images - self.image[pixels], 0.0) * stack.root
        left = residual - (residual @ basis) @ basis.mT
        return (0.5 * (left**2).sum(1) / len(stack)).numpy()


def preference(better: HeldOutEvaluation, worse: HeldOutEvaluation) -> float:
    """Vuong's statistic for `better` against `worse`: mean difference of the losses over its error."""
    difference = worse.losses - better.losses
    error = difference.std(ddof=1) / np.sqrt(better.stack.independent)
    return float(difference.mean() / error) if error > 0 else 0.0


def noise_floor(judge: HeldOutEvaluation) -> float:
    """What noise alone leaves of the gap: a normal deviate is √(2/π) σ away from zero on average.

    What frames differ by in pointing, flux and background is no noise: it is refitted. The root of a
    variance that n frames give is too small by 1 / 4 (n - 1) on average.
    """
    stack = judge.stack
    good, freedom = stack.root > 0, len(stack) - 1
    left = stack.deviations - (stack.deviations @ judge.basis) @ judge.basis.mT
    variance = stack.variance_e2 * (left**2).sum(0) / freedom / stack.independent
    noise_e = variance[good].sqrt().sum() * (1 + 1 / (4 * freedom))
    return float(np.sqrt(2 / np.pi) * noise_e / stack.mean_e[good].sum())


def gap_between(before: HeldOutEvaluation, after: HeldOutEvaluation) -> Gap:
    """Gaps of the models `before` and `after` on the same frames."""
    return Gap(before.gap, after.gap, noise_floor(before))
