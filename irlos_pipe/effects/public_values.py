"""Public values of effects: sizes and directions, rows, means over estimates, standard errors."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from irlos_pipe.conventions.text import rounded_by_error
from irlos_pipe.effects.base import Effect

STEP = 1e-3  # of numerical derivatives of public values, in standard errors of the parameters
Describe = Callable[[np.ndarray], dict[str, Any]]


class Measured(float):
    """A public value that is written with its standard error, whatever the format says of its digits."""

    sigma: float

    def __new__(cls, value: float, sigma: float) -> "Measured":
        made = super().__new__(cls, value)
        made.sigma = float(sigma)
        return made

    def __format__(self, pattern: str) -> str:
        return rounded_by_error(float(self), self.sigma, pattern)


def measured(public: Mapping[str, Any], sigma: Mapping[str, Any]) -> dict[str, Any]:
    """Return the `public` values, numbers with their standard errors `sigma` where there are any."""
    return {
        key: Measured(value, sigma[key])
        if isinstance(value, (int, float)) and isinstance(sigma.get(key), (int, float))
        else value
        for key, value in public.items()
    }


def size_and_angle(x: float, y: float) -> tuple[float, float]:
    """Size of (`x`, `y`), and its direction from +x towards +y in [0, 360) [deg]."""
    return float(np.hypot(x, y)), float(np.rad2deg(np.arctan2(y, x)) % 360)


def components(size: float, angle_deg: float) -> list[float]:
    """The components x and y of a `size` in the direction `angle_deg`."""
    angle = np.deg2rad(angle_deg)
    return [float(size * np.cos(angle)), float(size * np.sin(angle))]


def rows_of(public: Mapping[str, Any]) -> list[tuple[str, float]]:
    """Labels and numbers, such as ``("sigma_mas", 7.0)`` or ``("tip_nm 3", -20.0)``."""
    return [row for name, value in public.items() for row in _rows(name, value)]


def mean_of(estimates: Sequence[Any]) -> Any:
    """Public values with every number the mean over estimates of the same effect."""

    def mean(first: Any, *others: Any) -> Any:
        return first if all(one == first for one in others) else float(np.mean([first, *others]))

    return _map(mean, *estimates)


def _rows(name: str, value: Any) -> list[tuple[str, float]]:
    if isinstance(value, Mapping):
        return [row for key, one in value.items() for row in _rows(f"{name} {key}", one)]
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [row for number, one in enumerate(value, start=1) for row in _rows(f"{name} {number}", one)]
    return [(name, value)]


def public_sigma(
    base: Effect, values: np.ndarray, covariance: np.ndarray, *, shown: bool = False
) -> dict[str, Any]:
    """Return standard errors of the public values of an effect, to first order.

    The `covariance` (parameters, parameters) is that of `values` (parameters,) of `base`; with `shown`,
    errors are of what reports state of it instead, see `Effect.shown`.
    """
    steps, describe = np.sqrt(np.diag(covariance)) * STEP, base.shown if shown else base.describe
    steps = np.where(steps > 0, steps, 1e-9)
    changes = [public_difference(base, values + one, values - one, describe) for one in np.diag(steps)]

    def error(*along: float) -> float:
        slope = np.array(along) / (2 * steps)
        return float(np.sqrt(max(slope @ covariance @ slope, 0.0)))

    return _map(error, *changes)


def public_difference(
    effect: Effect, one: np.ndarray, other: np.ndarray, describe: Describe | None = None
) -> dict[str, Any]:
    """Return the difference of public values close to each other; angles may lie on both sides of 0 or 180°.

    `one` and `other` (parameters,) are the solver's values of the `effect`; `describe` makes public values of
    them, by default as the effect does.
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
    if isinstance(first, Sequence) and not isinstance(first, str):
        return [_map(function, *group) for group in zip(*values, strict=True)]
    return function(*values)
