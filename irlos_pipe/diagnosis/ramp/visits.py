"""The visits of a ramp to its offsets, and what each error of the focus stage would add to them.

Estimates of one visit share the errors of the PSF model, so a visit's mean is known to no better than
`MODEL_NM`, however many frames it has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.effects import CATALOGUE
from irlos_pipe.effects.focus_stage import travel_direction
from irlos_pipe.effects.planes import RampEffect

MODEL_NM = 4.0  # error of a visit's mean that no number of frames lowers


@dataclass(frozen=True)
class Visits:
    """Frames at one offset in a row.

    Attributes
    ----------
    all_nm : ndarray, (all visits,)
        Offsets in order of recording.
    good : ndarray of bool, (all visits,)
        Those with estimates; where the stage turns, the first is left out, as it is not known from where
        its offset was reached.
    mean_nm, sigma_nm : ndarray, (good visits,)
    """

    all_nm: np.ndarray
    good: np.ndarray
    mean_nm: np.ndarray
    sigma_nm: np.ndarray

    @classmethod
    def of(cls, commanded_nm: np.ndarray, estimated_nm: np.ndarray, used: np.ndarray) -> Visits:
        """Means of the used frames.

        Parameters
        ----------
        commanded_nm, estimated_nm : ndarray, (frames,)
            In order of recording; failed estimates are NaN.
        used : ndarray of bool, (frames,)

        Raises
        ------
        ValueError
            With fewer than three visits.
        """
        starts = np.flatnonzero(np.diff(commanded_nm, prepend=np.nan) != 0)
        offsets = commanded_nm[starts]
        groups = [g[np.isfinite(g)] for g in np.split(np.where(used, estimated_nm, np.nan), starts[1:])]
        good = np.array([len(group) > 0 for group in groups]) & ~_of_unknown_history(offsets)
        if good.sum() < 3:
            raise ValueError("a diagnosis of a ramp needs three visits to offsets, with estimates")
        means, errors = np.array([_mean(groups[i]) for i in np.flatnonzero(good)]).T
        return cls(offsets, good, means, np.hypot(errors, MODEL_NM))

    @property
    def commanded_nm(self) -> np.ndarray:
        """Offsets of the good visits."""
        return self.all_nm[self.good]

    def course(self, effect: RampEffect) -> np.ndarray:
        """What a unit of the effect adds, over its standard error, (good visits,)."""
        return course(effect, self.all_nm)[self.good] / self.sigma_nm


def _mean(values: np.ndarray) -> tuple[float, float]:
    """Mean and its standard error; a single value has none."""
    error = np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
    return float(np.mean(values)), float(error)


def _turns(offsets_nm: np.ndarray) -> bool:
    """Whether the stage moves both ways."""
    return len(set(travel_direction(offsets_nm)) - {0}) > 1


def _of_unknown_history(offsets_nm: np.ndarray) -> np.ndarray:
    """Visits before the first move, where the direction matters because it changes later."""
    return (travel_direction(offsets_nm) == 0) & _turns(offsets_nm)


def course(effect: RampEffect, commanded_nm: np.ndarray) -> np.ndarray:
    """What a unit of `effect` adds to the introduced defocus at the offsets `commanded_nm`, (offsets,)."""
    zero, one = torch.zeros(len(commanded_nm), dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    return effect.apply(one, zero, np.asarray(commanded_nm, float)).numpy()


def candidates(visits: Visits) -> list[RampEffect]:
    """All errors of the stage, those of a part of the ramp included."""
    kinds = [kind for kind in CATALOGUE.values() if issubclass(kind, RampEffect)]
    offsets_nm = np.unique(visits.commanded_nm)
    return [
        *(one for kind in kinds for one in kind.on_whole_ramp(turns=_turns(visits.all_nm))),
        *(one for kind in kinds for one in kind.on_parts(offsets_nm)),
    ]
