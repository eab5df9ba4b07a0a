"""Errors of the focus stage: `focus_stage_scale`, `focus_stage_hysteresis` and `focus_stage_offset`.

``reached = (1 + fraction) commanded + direction · nm + scatter + bias``
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from irlos_pipe.simulate.effects.base import FocusStageEffect, SimulatedEffect, own, wider

REST_NM = 0.0  # where the stage stands before the first move


@dataclass(frozen=True)
class FocusStageScale(FocusStageEffect):
    """The introduced defocus is larger than commanded by a `fraction`."""

    name = "focus_stage_scale"
    fraction: float = wider(-1.0, 10.0)

    def reached_nm(
        self, reached_nm: np.ndarray, commanded_nm: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """See `FocusStageEffect.reached_nm`."""
        return reached_nm * (1 + self.fraction)


@dataclass(frozen=True)
class FocusStageHysteresis(FocusStageEffect):
    """Bias by the direction of travel.

    Attributes
    ----------
    nm : float
        Bias after moving towards larger positions, its opposite otherwise.
    scatter_nm : float
        RMS of a part that is drawn for every move.
    direction : float, optional
        +1 or -1: direction of the move that led to the first position, if it was not from 0.
    """

    name = "focus_stage_hysteresis"
    nm: float = wider(-1e4, 1e4)
    scatter_nm: float = own("nm RMS, drawn for every move", 0.0, 5000.0, 0.0)
    direction: float | None = own("+1 or -1, of the move to the first position", -1.0, 1.0)

    def reached_nm(
        self, reached_nm: np.ndarray, commanded_nm: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """See `FocusStageEffect.reached_nm`."""
        moves = np.cumsum(np.diff(commanded_nm, prepend=commanded_nm[0]) != 0)
        scatter_nm = self.scatter_nm * rng.standard_normal(moves[-1] + 1)[moves]
        return reached_nm + (travel_directions(commanded_nm, self.direction) * self.nm + scatter_nm)


@dataclass(frozen=True)
class FocusStageOffset(FocusStageEffect):
    """Bias `nm` of the commanded positions larger than `above_nm` and smaller than `below_nm`."""

    name = "focus_stage_offset"
    nm: float = wider(-1e4, 1e4)
    above_nm: float | None = None
    below_nm: float | None = None

    def reached_nm(
        self, reached_nm: np.ndarray, commanded_nm: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """See `FocusStageEffect.reached_nm`."""
        above_nm = -np.inf if self.above_nm is None else self.above_nm
        below_nm = np.inf if self.below_nm is None else self.below_nm
        return reached_nm + np.where((commanded_nm > above_nm) & (commanded_nm < below_nm), self.nm, 0.0)


def reached_nm(
    commanded_nm: ArrayLike, effects: Iterable[SimulatedEffect], rng: np.random.Generator
) -> np.ndarray:
    """Return the defocus that the stage introduces, (positions,) [nm RMS].

    Parameters
    ----------
    commanded_nm : array-like of float, (positions,)
        In the order of time [nm RMS].
    effects : iterable of SimulatedEffect
        Those of the focus stage act, one after the other.
    rng : numpy.random.Generator
    """
    commanded = np.asarray(commanded_nm, float)
    reached = commanded
    for effect in effects:
        if isinstance(effect, FocusStageEffect):
            reached = effect.reached_nm(reached, commanded, rng)
    return reached


def travel_directions(commanded_nm: np.ndarray, first: float | None = None) -> np.ndarray:
    """Return the direction of the last move, +1 towards larger positions; a stage that stays keeps it.

    Parameters
    ----------
    commanded_nm : ndarray, (positions,)
        In the order of time [nm RMS].
    first : float, optional
        Of the move to the first position; by default the stage comes from `REST_NM`.

    Returns
    -------
    ndarray, (positions,)
        0 before the first move.
    """
    directions, last = [], 0.0
    for index, move in enumerate(np.diff(commanded_nm, prepend=REST_NM)):
        last = first if index == 0 and first is not None else float(np.sign(move)) or last
        directions.append(last)
    return np.array(directions)
