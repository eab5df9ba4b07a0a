"""Standard errors of public values, from the covariance of the solver's parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from irlos_pipe.effects.base import Effect

STEP = 1e-3  # of a standard error, in derivatives of public values
Describe = Callable[[np.ndarray], dict[str, Any]]


def public_sigma(
    base: Effect, values: np.ndarray, covariance: np.ndarray, *, shown: bool = False
) -> dict[str, Any]:
    """Return standard errors of the public values of an effect, to first order.

    Parameters
    ----------
    base : Effect
    values : ndarray, (parameters,)
    covariance : ndarray, (parameters, parameters)
        Of the values.
    shown : bool
        Of what a reader is told of it instead, see `Effect.shown`.
    """
    steps, describe = np.sqrt(np.diag(covariance)) * STEP, base.shown if shown else base.describe
    slopes = [
        public_difference(base, values + one, values - one, describe)
        for one in np.diag(np.where(steps > 0, steps, 1e-9))
    ]
    return _combined(slopes, covariance, 2 * np.where(steps > 0, steps, 1e-9))


def public_difference(
    effect: Effect, one: np.ndarray, other: np.ndarray, describe: Describe | None = None
) -> dict[str, Any]:
    """Return the difference of public values close to each other; angles may lie on both sides of 0 or 180°.

    Parameters
    ----------
    effect : Effect
    one, other : ndarray, (parameters,)
        Solver's values of it.
    describe : callable, optional
        Makes public values of them; by default the effect's own.
    """
    public = describe or effect.describe
    change = _map(lambda a, b: float(a - b), public(one), public(other))
    angles = [key for key in change if effect.role_of(key) == "direction"]
    return change | {key: (change[key] + 90.0) % 180.0 - 90.0 for key in angles}


def _map(function: Callable, *values: Any) -> Any:
    """Apply a function of numbers to public values of the same shape."""
    first = values[0]
    if isinstance(first, Mapping):
        return {key: _map(function, *(value[key] for value in values)) for key in first}
    if isinstance(first, Sequence):
        return [_map(function, *group) for group in zip(*values, strict=True)]
    return function(*values)


def _combined(differences: Sequence[dict], covariance: np.ndarray, widths: np.ndarray) -> dict[str, Any]:
    def error(*along: float) -> float:
        slope = np.array(along) / widths
        return float(np.sqrt(max(slope @ covariance @ slope, 0.0)))

    return _map(error, *differences)
