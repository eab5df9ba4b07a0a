"""What effects are in terms of modes: their part of the static wavefront, and its change with time.

Petals, bumps and high orders are not orthogonal to the modes on an obscured pupil; a report and a
correction need the modes of their sum. The effects' OPD is projected on piston and the estimated modes by
least squares over the clear pupil.
"""

from collections.abc import Sequence

import numpy as np
import torch

from irlos_pipe.effects import Effect, EffectSet, FixedEffect
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.numerics.directional import Directional


def effects_in_modes_nm(
    effects: EffectSet, values: torch.Tensor, nolls: Sequence[int]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the part of each mode that the effects hold, (modes,), and its derivatives.

    These are (modes, effect parameters), at `values` (effect parameters,).
    """
    if not effects.at("pupil"):
        return torch.zeros(len(nolls)), torch.zeros(len(nolls), len(values))
    grid = effects.grids.pupil
    weight = np.clip(grid.amplitude.ravel() / grid.light, 0, 1)
    basis = grid.modes([1, *nolls]).reshape(len(nolls) + 1, -1)
    project = torch.as_tensor(np.linalg.solve((basis * weight) @ basis.T, basis * weight)[1:])

    def modes(v: torch.Tensor) -> torch.Tensor:
        return project @ effects.opd_nm(v).flatten()

    change = Directional(modes, values)
    slopes = [change.by(index) for index in range(len(values))]
    return modes(values), torch.stack(slopes, dim=1) if slopes else torch.zeros(len(nolls), 0)


def whole_wavefront(problem: ImageFit, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what effects add to the modes, (modes,), and the derivatives of their sum, (modes, parameters).

    The parameters are `x` (parameters,).
    """
    layout = problem.layout
    added, slopes = effects_in_modes_nm(problem.model.effects, x[layout.effect_values], layout.nolls)
    derivatives = torch.zeros(len(layout.nolls), layout.size, dtype=torch.float64)
    derivatives[:, layout.modes] = torch.eye(len(layout.nolls), dtype=torch.float64)
    derivatives[:, layout.effect_values] = slopes.double()
    return added, derivatives


def drifts(effect: Effect) -> bool:
    """Return whether the effect is a change with time that is still to be estimated."""
    return effect.plane == "time" and len(effect.parameters) > 0


def starts_as_told(effect: Effect) -> bool:
    """Return whether the effect, one that not every recording has, starts from values found before."""
    if effect.usual or not isinstance(effect, FixedEffect) or not effect.free:
        return False
    return not np.array_equal(effect.values, effect.base.null_values)


def measured_drift(effect: Effect, nolls: Sequence[int], frames_nm: np.ndarray) -> FixedEffect:
    """Return the effect held at what the estimates of single frames show of it, by least squares.

    The mean image shows a drift to second order only, and not its sign; the frames show both. The `effect` is
    of the plane `time` and linear in its parameters, all of which are free; the modes `nolls` of `frames_nm`
    (frames, modes) are estimates at equal intervals of time. Raises ValueError if a mode that is to drift is
    not estimated.
    """
    when = torch.linspace(0, 1, len(frames_nm), dtype=torch.float64)
    still = torch.zeros(len(frames_nm), len(nolls), dtype=torch.float64)
    units = torch.eye(len(effect.base.parameters), dtype=torch.float64)
    courses = [effect.base.apply(unit, still, tuple(nolls), when) for unit in units]
    frames = torch.as_tensor(frames_nm)
    return FixedEffect(effect.base, [float((c * frames).sum() / c.square().sum()) for c in courses])
