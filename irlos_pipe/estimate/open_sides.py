"""The other side of what has a distance and a direction, in the fit of all modes.

Opposite sides of a displaced stop are degenerate to first order, and which is the right one shows only once
all modes are in the model. So the fit is repeated from the opposite side, and from every side where the stop
came to rest at its place.
"""

from collections.abc import Iterator

import numpy as np
import torch

from irlos_pipe.effects.base import AT_REST, direction_among, on_every_side
from irlos_pipe.estimate.open_fit import Opened, OpenFit, settled
from irlos_pipe.numerics.levenberg_marquardt import solve
from irlos_pipe.numerics.solution import INVALID


def likelier_side(opened: Opened, max_iterations: int) -> Opened:
    """Return a fit of all modes, or a likelier one with a fact of the instrument on another side.

    For `max_iterations` see `open_basis`.
    """
    problem, best = opened.problem, opened
    starts = list(_other_sides(problem, opened.solution.values[:1]))
    if not starts:
        return opened
    rough = problem.roughly()
    quick = rough.hastened()
    for start in starts:
        near = solve(quick, start, max_iterations=max_iterations)
        if near.status[0] == INVALID:
            continue
        found = settled(rough, quick, near, opened.law, max_iterations)
        if found is not None and float(found.solution.objective[0]) < float(best.solution.objective[0]):
            best = found
    return best


def _other_sides(problem: OpenFit, x: torch.Tensor) -> Iterator[torch.Tensor]:
    """Other places, (1, parameters), from which the fit may begin."""
    effects = problem.model.effects
    first = problem.layout.effect_values.start
    for label, effect in zip(effects.labels, effects.effects, strict=True):
        angle = direction_among(effect.parameters) if effect.base.fact else None
        if angle is None:
            continue
        own = slice(first + effects.columns_of(label).start, first + effects.columns_of(label).stop)
        values = x[0, own].numpy().copy()
        values[angle] += np.pi
        rests = values[0] <= effect.parameters[0].lower + AT_REST
        for side in on_every_side(effect) if rests else [values]:
            start = x.clone()
            start[0, own] = torch.from_numpy(side)
            yield start
