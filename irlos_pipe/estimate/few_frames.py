"""Errors of an estimate from one image or a few, whose scatter does not show them.

The noise model gives them. What the model misfits beyond noise, an error of its own or speckles that did
not average out, is counted as further noise of the same kind: variances grow by χ²/ν. A prior does not
become weaker by that, so with the inverse Hessian C, its part P from the prior and the factor s,
``cov = C (s (C⁻¹ - P) + P) C``.
"""

from __future__ import annotations

import numpy as np
import torch

from irlos_pipe.estimate.effect_modes import whole_wavefront
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.numerics.solution import INVALID, Solution


def covariance_from_noise(problem: ImageFit, solution: Solution) -> np.ndarray:
    """Return the covariance of the whole static wavefront, the mean over the fits [nm²], (modes, modes).

    Parameters
    ----------
    problem : ImageFit
        Its weights are those of the noise.
    solution : Solution
        Of the problem.
    """
    usable = [member for member, status in enumerate(solution.status) if status != INVALID]
    values, covariance = solution.values[usable], solution.covariance[usable]
    misfit = problem.members(torch.tensor(usable)).reduced_chi2(values).clamp_min(1.0)[:, None, None]
    precision = torch.diag_embed(problem.prior_precision[usable])
    scaled = misfit * covariance - (misfit - 1) * (covariance @ precision @ covariance)
    _, read = whole_wavefront(problem, values[0])
    return (read @ (scaled.mean(0) / len(usable)) @ read.mT).numpy()
