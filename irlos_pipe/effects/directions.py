"""Effects with a distance and a direction, such as a stop beside its place.

To first order opposite sides make the same image, which has a kink at no distance: a fit stays on its side.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from irlos_pipe.effects.base import Effect
from irlos_pipe.effects.declaration import Parameter

SIDES = 4  # on which a fit may begin
AT_REST = 1e-3  # of a distance: less is none


def direction_among(parameters: Sequence[Parameter]) -> int | None:
    """Return which of the free parameters of an effect is its direction; None without distance and direction.

    Parameters
    ----------
    parameters : sequence of Parameter
        The first is the distance, where there is one.
    """
    angles = [i for i, one in enumerate(parameters) if one.null is None and one.unit == "rad"]
    if not angles or parameters[0].null is None or parameters[0].null > parameters[0].lower:
        return None
    return angles[0]


def on_every_side(effect: Effect) -> list[np.ndarray]:
    """Return values of the free parameters, at their starts but for the direction; none without one.

    Parameters
    ----------
    effect : Effect
    """
    angle = direction_among(effect.parameters)
    if angle is None:
        return []
    declared = {one.name: one.start for one in effect.base.parameters}
    starts = np.array([declared[one.name] for one in effect.parameters])
    sides = np.tile(starts, (SIDES, 1))
    sides[:, angle] = np.arange(SIDES) * 2 * np.pi / SIDES
    return [*sides]
