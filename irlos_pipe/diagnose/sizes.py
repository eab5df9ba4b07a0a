"""Sizes of effects under their public names: errors of what was found, limits of what was not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ..effects import Effect, Pinned
from .cube import Stack
from .detect import Score
from .drift_check import linear_gain
from .fitting import Fitted

STEP = 1e-3  # of a standard error, in derivatives of public values


def parameter_covariance(stack: Stack, fitted: Fitted) -> np.ndarray:
    """Covariance of all parameters: from the scatter between frames, at least that of the Fisher matrix."""
    fisher = fitted.solution.covariance[0].numpy()
    if stack.photon_limited:
        return fisher
    scatter = stack.covariance_of_mean(stack.deviations @ linear_gain(stack, fitted).mT).numpy()
    ratio = np.sqrt(np.maximum(np.diag(fisher) / np.maximum(np.diag(scatter), 1e-300), 1.0))
    return scatter * np.outer(ratio, ratio)


def public_sigma(bare: Effect, values: np.ndarray, covariance: np.ndarray) -> dict[str, Any]:
    """Standard errors of the public values, by linear propagation of the solver's covariance."""
    steps = np.sqrt(np.diag(covariance)) * STEP
    slopes = [
        _difference(bare.describe(values + one), bare.describe(values - one))
        for one in np.diag(np.where(steps > 0, steps, 1e-9))
    ]
    return _combined(slopes, covariance, 2 * np.where(steps > 0, steps, 1e-9))


def detectable(score: Score, gain: float) -> dict[str, Any]:
    """Public size at which the effect would lower χ² by `gain` times its inflation.

    Positions and directions, which do not change with the size, are left out.
    """
    bare = score.candidate.effect if isinstance(score.candidate, Pinned) else score.candidate
    null = np.array(score.candidate.null_values, float)
    size = np.where(np.isfinite(score.smallest), score.smallest, 0.0) * np.sqrt(gain)
    if not _is_table(bare.describe(bare.null_values)):
        size[1:] = 0.0
    full = score.candidate.all_values if isinstance(score.candidate, Pinned) else np.asarray
    absent, present = (bare.describe(np.asarray(full(v), float)) for v in (null, null + size))
    return {key: v for key, v in _difference(present, absent).items() if np.any(np.abs(_flat(v)) > 0)}


def within_reach(score: Score, gain: float) -> bool:
    """Whether the size that would be detected lies within the bounds of the effect's parameters."""
    null = np.array(score.candidate.null_values, float)
    limits = np.array([(p.lower, p.upper) for p in score.candidate.parameters])
    reach = np.maximum(limits[:, 1] - null, null - limits[:, 0])
    return bool(np.any(score.smallest * np.sqrt(gain) < reach))


def _is_table(public: Mapping) -> bool:
    return any(isinstance(value, (Mapping, Sequence)) for value in public.values())


def _flat(value: Any) -> list[float]:
    if isinstance(value, Mapping):
        return [number for one in value.values() for number in _flat(one)]
    if isinstance(value, Sequence):
        return [number for one in value for number in _flat(one)]
    return [value]


def _map(function: Callable, *values: Any) -> Any:
    """Apply a function of numbers to public values of the same shape."""
    first = values[0]
    if isinstance(first, Mapping):
        return {key: _map(function, *(value[key] for value in values)) for key in first}
    if isinstance(first, Sequence):
        return [_map(function, *group) for group in zip(*values, strict=True)]
    return function(*values)


def _difference(one: Mapping, other: Mapping) -> dict[str, Any]:
    return _map(lambda a, b: float(a - b), one, other)


def _combined(differences: Sequence[dict], covariance: np.ndarray, widths: np.ndarray) -> dict[str, Any]:
    def error(*along: float) -> float:
        slope = np.array(along) / widths
        return float(np.sqrt(max(slope @ covariance @ slope, 0.0)))

    return _map(error, *differences)
