"""Whether the wavefront changed during the recording: estimates of single frames against time.

The mean image hardly shows a drift. One linear step from the common solution gives every frame its
coefficients; their slopes are judged by their own scatter about the straight line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..effects import Pinned
from ..effects.drift import NcpaDrift
from .cube import Stack
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

    def effect(self) -> Pinned:
        """The drift, held at what was measured."""
        return Pinned(NcpaDrift(self.nolls), self.change_nm)


def frame_modes_nm(stack: Stack, fitted: Fitted) -> np.ndarray:
    """Coefficients of every frame beyond those of the mean, (frames, modes), by one linear step."""
    modes = fitted.problem.layout.modes
    return (stack.deviations @ linear_gain(stack, fitted).mT)[:, modes].numpy()


def linear_gain(stack: Stack, fitted: Fitted):
    """Matrix from whitened pixels to all parameters, (parameters, pixels)."""
    jacobian = fitted.problem.predict_and_jacobian(fitted.x)[1][0].cpu().double()
    return fitted.solution.covariance[0] @ (jacobian * stack.root)


def measure_drift(stack: Stack, fitted: Fitted) -> Drift:
    """Slopes of the low modes, and how significant they are together."""
    nolls = tuple(noll for noll in NOLLS if noll in fitted.problem.layout.nolls)
    columns = [fitted.problem.layout.nolls.index(noll) for noll in nolls]
    series = frame_modes_nm(stack, fitted)[:, columns]
    when = stack.when - stack.when.mean()
    change = when @ series / (when @ when)
    scatter = np.cov((series - np.outer(when, change)).T) * (len(when) - 1) / (len(when) - 2)
    covariance = scatter / (when @ when) * len(when) / stack.independent
    tested = [i for i, noll in enumerate(nolls) if noll not in POINTING]
    own = covariance[np.ix_(tested, tested)]
    hotelling = float(change[tested] @ np.linalg.solve(own, change[tested]))
    significance = gaussian_sigma(hotelling, len(tested), stack.independent - 1)
    return Drift(nolls, change, np.sqrt(np.diag(covariance)), significance)
