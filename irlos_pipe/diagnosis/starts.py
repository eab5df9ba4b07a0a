"""Other places from which a fit may begin, where it may have ended in a false minimum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from irlos_pipe.diagnosis.fitted import Fitted, begun_at
from irlos_pipe.effects import Effect
from irlos_pipe.optics.zernike import noll_to_nm

STARTS, START_NM = 2, 60.0  # further wavefronts: RMS of the first radial order, falling
OTHER_SIDES = (2 * np.pi / 3, -2 * np.pi / 3)  # from where a distance came to rest
AT_REST = 1e-3  # of a distance


def other_wavefronts(near: Fitted) -> list[Fitted]:
    """`near` with other wavefronts: none, and some at random, less in every radial order.

    Parameters
    ----------
    near : Fitted
    """
    generator = torch.Generator().manual_seed(STARTS)
    nolls, modes = near.problem.layout.nolls, near.problem.layout.modes
    falling = [START_NM * min(1.0, 2.0 / noll_to_nm(noll)[0]) ** 1.5 for noll in nolls]
    size = torch.tensor(falling, dtype=torch.float64)
    size[:2] = 0.0
    pointing = near.x[0, modes] * (size == 0)
    found = []
    for number in range(STARTS):
        drawn = torch.randn(len(nolls), generator=generator, dtype=torch.float64) * size
        x = near.x.clone()
        x[0, modes] = pointing + (drawn if number else 0.0)
        found.append(replace(near, solution=replace(near.solution, values=x)))
    return found


def on_other_sides(fitted: Fitted) -> list[list[Effect]]:
    """The effects of a model, to begin where it is but for one of them, which begins elsewhere.

    Parameters
    ----------
    fitted : Fitted
    """
    effects = fitted.continued_by_label()
    return [
        [*(effects | {label: begun_at(effects[label], values)}).values()]
        for label in effects
        for values in other_sides(fitted, label)
    ]


def other_sides(fitted: Fitted, label: str) -> list[np.ndarray]:
    """Other values of an effect with a distance and a direction; none of an effect without.

    What began on the wrong side and came to rest at no distance, where the image has a kink, begins on the
    others; what has a distance on the opposite one, which to first order looks alike.

    Parameters
    ----------
    fitted : Fitted
    label : str
        Of the effect.
    """
    free = fitted.effect(label).parameters
    angles = [i for i, one in enumerate(free) if one.null is None and one.unit == "rad"]
    if not angles or free[0].null is None or free[0].null > free[0].lower:
        return []
    values = fitted.x[0, fitted.columns_of(label)].numpy()
    resting = values[0] <= free[0].lower + AT_REST
    found = []
    for turn in OTHER_SIDES if resting else (np.pi,):
        other = values.copy()
        other[0] = fitted.effect(label).base.parameters[0].start if resting else values[0]
        other[angles[0]] += turn
        found.append(other)
    return found
