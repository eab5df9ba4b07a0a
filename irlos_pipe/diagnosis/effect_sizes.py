"""Sizes of effects under their public names: errors of what was found, limits of what was not."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from irlos_pipe.diagnosis.cube import Stacks
from irlos_pipe.diagnosis.fitting import Fitted
from irlos_pipe.diagnosis.null_model import SURE, surely_exceeding
from irlos_pipe.diagnosis.scores import Score
from irlos_pipe.effects import Parameter
from irlos_pipe.effects.public_values import public_difference

FAR = 1e3  # standard errors, as the width of a prior where there is none
ALONE = 0.25  # part of a parameter that others determine, below which it is undetermined by itself
UNDETERMINED = 0.5  # part of the prior's variance that is left, from which the data determine nothing
NOTHING = 1e-9  # size that stands for none, as of rounding


def parameter_covariance(stack: Stacks, fitted: Fitted) -> np.ndarray:
    """Covariance of all parameters of `fitted`, from the scatter between the frames of `stack`.

    It is at least that of the Fisher matrix; parameters in which the frames do not scatter have its variance,
    and no covariance with others.
    """
    fisher = fitted.solution.covariance[0].numpy()
    if stack.photon_limited or fitted.complete:
        return fisher
    gain = fitted.solution.covariance[0] @ (fitted.linearised[1] * stack.root)
    return _at_least(fisher, stack.covariance_of(gain.mT).numpy())


def _at_least(fisher: np.ndarray, scatter: np.ndarray) -> np.ndarray:
    """The covariance `scatter` with the variances of `fisher` where these are larger, both (n, n)."""
    least, variance = np.diag(fisher), np.diag(scatter)
    shown = variance > np.finfo(float).eps * least
    ratio = np.sqrt(np.maximum(np.where(shown, least, 0.0) / np.where(shown, variance, 1.0), 1.0))
    covariance = np.where(np.outer(shown, shown), scatter, 0.0) * np.outer(ratio, ratio)
    np.fill_diagonal(covariance, np.where(shown, np.diag(covariance), least))
    return covariance


def determined(parameters: Sequence[Parameter], covariance: np.ndarray) -> np.ndarray:
    """The `covariance` of free `parameters` without the directions that only the prior holds.

    Petals may move as one, which tip, tilt and piston of the whole pupil do as well: the prior keeps such a
    direction at zero, and its width says nothing about the effect. A parameter that is such a direction by
    itself has its variance: nothing else says that the data do not determine it.
    """
    sigma, variance = np.array([p.prior_sigma for p in parameters]), np.diag(covariance)
    measured = np.isfinite(variance) & (variance > 0)  # not a direction in which the size is zero
    scale = np.where(np.isfinite(sigma), sigma, np.sqrt(np.where(measured, variance, 1.0)) * FAR)
    units = np.outer(scale, scale)
    relative = np.where(np.outer(measured, measured), covariance, 0.0) / units
    values, vectors = np.linalg.eigh(relative)
    kept = vectors[:, values < UNDETERMINED]
    projector = kept @ kept.T
    found = (projector @ relative @ projector) * units
    alone = np.diag(projector) < ALONE
    return np.where(np.diag(alone), relative * units, found)


class Covariances:
    """Covariances of the effects and modes of a model, by whose `misfit` they grow."""

    def __init__(self, stack: Stacks, fitted: Fitted, misfit: float = 1.0):
        self.stack, self.fitted, self.misfit = stack, fitted, misfit

    @cached_property
    def _whole(self) -> np.ndarray:
        return self.misfit * parameter_covariance(self.stack, self.fitted)

    def of(self, label: str) -> np.ndarray:
        """Of all parameters of the effect with a `label`; zero for what is held."""
        effect, columns = self.fitted.effect(label), self.fitted.columns_of(label)
        full = np.zeros((len(effect.base.parameters), len(effect.base.parameters)))
        own = determined(effect.parameters, self._whole[np.ix_(columns, columns)])
        full[np.ix_(effect.free, effect.free)] = own
        return full

    def modes_sigma_nm(self) -> np.ndarray:
        return np.sqrt(np.diag(self._whole)[self.fitted.problem.layout.modes])


def detectable(score: Score) -> dict[str, Any]:
    """Public size at which the effect would surely be seen, parameter by parameter.

    Positions and directions, which do not change with the size, are left out; of a displacement whose
    direction does not matter both components are its size. `score` is that of the effect.
    """
    null = np.array(score.candidate.null_values, float)
    sizes = _surely_seen(score)
    sizes = np.where(np.isfinite(sizes), sizes, 0.0)
    effect, absent = score.candidate, score.candidate.describe(null)
    is_table = any(isinstance(value, (Mapping, Sequence)) for value in absent.values())
    alone = [sizes] if is_table else np.diag(sizes)
    changes = [public_difference(effect, null + one, null) for one in alone]
    largest = {key: max((one[key] for one in changes), key=_size) for key in absent}
    roles = {key: effect.role_of(key) for key in absent}
    components = [key for key, role in roles.items() if role == "component"]
    if components:
        largest |= dict.fromkeys(components, float(np.hypot(*(largest[key] for key in components))))
    moving = {key for key, role in roles.items() if role in ("position", "direction")}
    return {key: v for key, v in largest.items() if key not in moving and _size(v) > NOTHING}


def within_reach(score: Score, *, plausible: bool = False) -> bool:
    """Whether the size that would surely be seen lies within the bounds of the effect's parameters.

    Or, if `plausible`, within the usual range.
    """
    null = np.array(score.candidate.null_values, float)
    limits = np.array([p.plausible if plausible else (p.lower, p.upper) for p in score.candidate.parameters])
    reach = np.maximum(limits[:, 1] - null, null - limits[:, 0])
    return bool(np.any(_surely_seen(score) < reach))


def _surely_seen(score: Score) -> np.ndarray:
    """Size of each parameter alone whose odds would surely be for a name; infinite where none would be.

    The odds of an effect are half of the fall of χ² less what the width of its prior costs, see
    `scores.Score.log_odds`; of a place, as many trials as there are places. Shape (parameters,).
    """
    priors = np.array([one.proper_prior[1] for one in score.candidate.parameters])
    tested = int(np.isfinite(score.smallest).sum())
    width = np.log1p((priors / score.smallest) ** 2).sum()
    limit = 2 * (SURE + np.log(score.trials)) + width
    return score.smallest * np.sqrt(surely_exceeding(limit, max(tested, 1)))


def _flat(value: Any) -> list[float]:
    if isinstance(value, Mapping):
        return [number for one in value.values() for number in _flat(one)]
    if isinstance(value, Sequence):
        return [number for one in value for number in _flat(one)]
    return [value]


def _size(value: Any) -> float:
    return float(np.max(np.abs(_flat(value))))
