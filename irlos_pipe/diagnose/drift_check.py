"""Whether the wavefront changed during the recording: estimates of single frames against time.

The mean image hardly shows a drift. One linear step from the common solution gives every frame its
coefficients; their slopes are judged by their own scatter about the straight line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats

from ..effects import Pinned
from ..effects.drift import NcpaDrift
from ..estimate.image_fit import ImageFit
from ..estimate.solve import scaled_inverse
from .cube import Stack, Stacks
from .detect import gaussian_sigma
from .fitting import Fitted

NOLLS = range(2, 12)
POINTING = (2, 3)  # where the star is says nothing about the optics: no part of the test


@dataclass(frozen=True)
class Drift:
    """Straight lines through the coefficients of the frames.

    Attributes
    ----------
    nolls : tuple of int
    change_nm, sigma_nm : ndarray, (modes,)
        From the first frame to the last.
    significance : float
        In Gaussian σ, pointing left out.
    """

    nolls: tuple[int, ...]
    change_nm: np.ndarray
    sigma_nm: np.ndarray
    significance: float

    def detectable_nm(self, sure: float) -> np.ndarray:
        """Change of each mode alone that would be significant, (modes,)."""
        tested = sum(noll not in POINTING for noll in self.nolls)
        return self.sigma_nm * np.sqrt(stats.chi2.isf(stats.norm.sf(sure), tested))

    def effect(self) -> Pinned:
        """The drift, held at what was measured."""
        return Pinned(NcpaDrift(self.nolls), self.change_nm)


def frame_modes_nm(stack: Stack, part: ImageFit, x: torch.Tensor) -> np.ndarray:
    """Coefficients of every frame of a recording beyond those of its mean, (frames, modes).

    By one linear step, for which the recording stands by itself.
    """
    hessian = part.normal_equations(x, torch.arange(1))[2]
    jacobian = part.predict_and_jacobian(x)[1][0].cpu().double()
    gain = scaled_inverse(hessian)[0] @ (jacobian * stack.root)
    return (stack.deviations @ gain.mT)[:, part.layout.modes].numpy()


def measure_drift(stack: Stack | Stacks, fitted: Fitted) -> Drift:
    """Slopes of the low modes, and how significant they are together, where they are most so."""
    problem = fitted.problem
    found = [
        _drift(one, part, problem.part(fitted.x, number), trials=len(problem.parts))
        for number, (one, part) in enumerate(zip(stack.parts, problem.parts, strict=True))
    ]
    return max(found, key=lambda one: one.significance)


def _drift(stack: Stack, part: ImageFit, x: torch.Tensor, trials: int) -> Drift:
    """Of one recording."""
    nolls = tuple(noll for noll in NOLLS if noll in part.layout.nolls)
    columns = [part.layout.nolls.index(noll) for noll in nolls]
    series = frame_modes_nm(stack, part, x)[:, columns]
    when = stack.when - stack.when.mean()
    change = when @ series / (when @ when)
    scatter = np.cov((series - np.outer(when, change)).T) * (len(when) - 1) / (len(when) - 2)
    covariance = scatter / (when @ when) * len(when) / stack.independent
    tested = [i for i, noll in enumerate(nolls) if noll not in POINTING]
    own = covariance[np.ix_(tested, tested)]
    hotelling = float(change[tested] @ np.linalg.solve(own, change[tested]))
    significance = gaussian_sigma(hotelling, len(tested), stack.independent - 1, trials)
    return Drift(nolls, change, np.sqrt(np.diag(covariance)), significance)
