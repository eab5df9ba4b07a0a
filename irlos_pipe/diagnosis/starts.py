"""Other places from which a fit may begin, where it may have ended in a false minimum."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from irlos_pipe.conventions.modes import TIP_TILT
from irlos_pipe.diagnosis.fitted import Fitted
from irlos_pipe.effects.base import AT_REST, direction_among
from irlos_pipe.numerics.problem import ROUNDING

DIRECTIONS = 8  # in which the fit is searched for a fall from no distance, where the image has a kink


def with_wavefront(near: Fitted, zernike_nm: Mapping[int, float]) -> Fitted:
    """`near` with another wavefront where it is known, Noll index to nm RMS; it points as it did."""
    x = near.x.clone()
    for place, noll in enumerate(near.problem.layout.nolls):
        if noll not in TIP_TILT:
            x[0, place] = zernike_nm.get(noll, 0.0)
    return replace(near, solution=replace(near.solution, values=x))


def other_sides(fitted: Fitted, label: str) -> list[np.ndarray]:
    """Other values of an effect with a distance and a direction; none of an effect without.

    What has a distance begins on the opposite side, which is degenerate to first order. What began on the
    wrong side came to rest at no distance, where the image has a kink; it begins where the fit falls most
    steeply from there, or nowhere else if it rises on all sides.
    """
    angle = direction_of(fitted, label)
    if angle is None:
        return []
    other = fitted.x[0, fitted.columns_of(label)].numpy().copy()
    if not rests(fitted, label):
        other[angle] += np.pi
        return [other]
    downhill = _downhill(fitted, label, angle)
    if downhill is None:
        return []
    other[0], other[angle] = fitted.effect(label).base.parameters[0].start, downhill
    return [other]


def direction_of(fitted: Fitted, label: str) -> int | None:
    """Which free parameter of an effect is its direction; None of one without a distance and a direction."""
    return direction_among(fitted.effect(label).parameters)


def rests(fitted: Fitted, label: str) -> bool:
    """Whether an effect with a direction is at no distance."""
    if direction_of(fitted, label) is None:
        return False
    distance = float(fitted.x[0, fitted.columns_of(label)[0]])
    return distance <= fitted.effect(label).parameters[0].lower + AT_REST


def _downhill(fitted: Fitted, label: str, angle: int) -> float | None:
    """The direction in which the fit falls most from no distance; None if it falls in none.

    All other parameters are where they are best, so that to first order they would stay.
    """
    columns, which = fitted.columns_of(label), torch.zeros(1, dtype=torch.int64)

    def objective(distance: float, direction: float) -> float:
        x = fitted.x.clone()
        x[0, columns[0]] = fitted.effect(label).parameters[0].lower + distance
        x[0, columns[angle]] = direction
        return float(fitted.problem.objective(x, which))

    centred = objective(0.0, 0.0)
    directions = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    values = [objective(AT_REST, direction) for direction in directions]
    return float(directions[np.argmin(values)]) if min(values) < centred * (1 - ROUNDING) else None
