"""Many images measured one by one, as a loop does, in the form of a batch of LIFT."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from irlos_pipe.estimate.focus.sensor import Focus
from irlos_pipe.estimate.lift import LiftResult
from irlos_pipe.numerics.solution import CONVERGED, INVALID, STALLED, Solution

NOLLS = (2, 3, 4)
PARAMETERS = 5


def lift_singly(
    focus: Focus, images_e: np.ndarray, report: Callable[[int], object] | None = None
) -> LiftResult:
    """Measure every image by itself.

    Parameters
    ----------
    focus : Focus
    images_e : ndarray, (images, rows, columns)
    report : callable, optional
        Called with 1 after every image.
    """
    count = len(images_e)
    values, covariance = (
        np.full((count, PARAMETERS), np.nan),
        np.full((count, PARAMETERS, PARAMETERS), np.nan),
    )
    objective, chi2_nu = np.full((2, count), np.nan)
    iterations, status = np.zeros(count, np.int64), [INVALID] * count
    model_e = np.zeros(images_e.shape)
    for index, image in enumerate(images_e):
        _, found = focus.solved(image)
        if found is not None:
            values[index], covariance[index] = found.x, found.covariance
            objective[index], chi2_nu[index] = found.objective, found.chi2_nu
            iterations[index], status[index] = found.iterations, CONVERGED if found.converged else STALLED
            model_e[index] = focus.model_e(found)
        if report is not None:
            report(1)
    x, errors, counts, least = map(torch.from_numpy, (values, covariance, iterations, objective))
    solution = Solution(x, errors, status, counts, least)
    modes = slice(0, len(NOLLS))
    return LiftResult(
        NOLLS,
        solution.values[:, modes],
        solution.covariance[:, modes, modes],
        solution,
        torch.from_numpy(model_e),
        torch.from_numpy(chi2_nu),
    )
