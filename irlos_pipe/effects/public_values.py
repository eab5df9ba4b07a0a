"""Public values of effects: sizes and directions, tables unrolled into rows, means over estimates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from irlos_pipe.conventions.text import rounded_by_error


class Measured(float):
    """A public value that is written with its standard error, whatever the format says of its digits.

    Parameters
    ----------
    value, sigma : float
    """

    sigma: float

    def __new__(cls, value: float, sigma: float) -> Measured:
        """Return the value with its error."""
        made = super().__new__(cls, value)
        made.sigma = float(sigma)
        return made

    def __format__(self, pattern: str) -> str:
        """Format as `rounded_by_error` does."""
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
    first = estimates[0]
    if isinstance(first, Mapping):
        return {key: mean_of([one[key] for one in estimates]) for key in first}
    if isinstance(first, Sequence) and not isinstance(first, str):
        return [mean_of(same) for same in zip(*estimates, strict=True)]
    return first if all(one == first for one in estimates) else float(np.mean(estimates))


def _rows(name: str, value: Any) -> list[tuple[str, float]]:
    if isinstance(value, Mapping):
        return [row for key, one in value.items() for row in _rows(f"{name} {key}", one)]
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [row for number, one in enumerate(value, start=1) for row in _rows(f"{name} {number}", one)]
    return [(name, value)]
