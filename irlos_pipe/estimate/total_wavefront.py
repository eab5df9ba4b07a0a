"""Zernike coefficients of the whole static wavefront: estimated modes plus what effects in the pupil add.

Petals, bumps and high orders are not orthogonal to the modes on an obscured pupil; a report and a
correction want the modes of their sum. The effects' OPD is projected on piston and the estimated modes by
least squares over the clear pupil.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from irlos_pipe.effects import EffectSet
from irlos_pipe.numerics.forward_mode import pushed
from irlos_pipe.optics.grids import PupilGrid


def effects_in_modes_nm(
    effects: EffectSet, values: torch.Tensor, nolls: Sequence[int]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Part of each mode that the effects hold, and its derivatives.

    Returns
    -------
    added_nm : tensor, (modes,)
    slopes : tensor, (modes, effect parameters)
    """
    if not effects.at("pupil"):
        return torch.zeros(len(nolls)), torch.zeros(len(nolls), len(values))
    project = torch.as_tensor(_projection(effects.grids.pupil, nolls))

    def modes(v: torch.Tensor) -> torch.Tensor:
        return project @ effects.opd_nm(v).flatten()

    directions = torch.eye(len(values), dtype=torch.float64)
    slopes = [pushed(modes, values, direction) for direction in directions]
    return modes(values), torch.stack(slopes, dim=1) if slopes else torch.zeros(len(nolls), 0)


def _projection(grid: PupilGrid, nolls: Sequence[int]) -> np.ndarray:
    """Matrix from an OPD on the grid, flattened, to the coefficients of `nolls`."""
    weight = np.clip(grid.amplitude.ravel() / grid.light, 0, 1)
    basis = grid.modes([1, *nolls]).reshape(len(nolls) + 1, -1)
    return np.linalg.solve((basis * weight) @ basis.T, basis * weight)[1:]
