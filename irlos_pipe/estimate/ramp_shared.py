"""Parameters that all images of a ramp share: object size and AO residual, fitted jointly.

In one image the size of the object and the defocus are degenerate, which is why the paper tuned
the kernel by hand; on a ramp the defocus changes and the object does not. The per-image
parameters are eliminated from the joint normal equations by the Schur complement, so the cost is
that of LIFT plus one small system. Speckles that a frame did not average out count as further noise: the
variances grow by χ²/ν, as in `few_frames`, so that priors keep their weight.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from irlos_pipe.effects.image_model import NOTHING, ImageModel
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.estimate.tabulated import tabulated
from irlos_pipe.numerics.levenberg_marquardt import scaled_inverse, solve
from irlos_pipe.numerics.solution import CONVERGED, MAX_ITERATIONS

OUTER_ITERATIONS = 12
STEP_SIGMA = 0.02  # converged when no shared parameter will move by more than this part of its error
# Fall of χ² per image that does not matter on the way: what it leaves of the per-image parameters, the
# elimination takes to first order.
ON_THE_WAY = 1.0


@dataclass(frozen=True)
class SharedFit:
    """Shared effect parameters with their covariance, and the per-image parameters at the optimum.

    Attributes
    ----------
    values : tensor, (shared,)
    covariance : tensor, (shared, shared)
        Per-image parameters marginalised, the misfit counted as noise.
    x : tensor, (images, parameters)
    status : str
    """

    values: torch.Tensor
    covariance: torch.Tensor
    x: torch.Tensor
    status: str


def fit_shared(problem: ImageFit, x: torch.Tensor) -> SharedFit:
    """Fit the free effect parameters of a problem's model to all its images together.

    Parameters
    ----------
    problem : ImageFit
        One parameter vector per image; its effects have free parameters, which start at `problem.held`.
    x : tensor, (images, parameters)
        Start of the per-image parameters.

    Returns
    -------
    SharedFit
    """
    parameters = problem.model.effects.parameters
    limits = torch.tensor([[p.lower, p.upper] for p in parameters], dtype=torch.float64)
    values, before = problem.held, math.inf
    status = MAX_ITERATIONS
    for _ in range(OUTER_ITERATIONS):
        x = _own_parameters(problem, x)
        gradient, information = _with_prior(parameters, values, *_reduced(problem, x))
        covariance = torch.linalg.inv(information)
        trial = (values - covariance @ gradient).clamp(limits[:, 0], limits[:, 1])
        step = float(((trial - values).abs() / torch.diagonal(covariance).sqrt()).max())
        values, problem = trial, problem.holding(trial)
        if _still_ahead(step, before) < STEP_SIGMA:
            status = CONVERGED
            break
        before = step
    return SharedFit(values, covariance, x, status)


def _own_parameters(problem: ImageFit, x: torch.Tensor) -> torch.Tensor:
    """Per-image parameters where the shared ones are held, from a table of images if there can be one."""
    model, modes = problem.model, problem.layout.modes
    held = tabulated(ImageModel(model.psf, model.effects.held(problem.held)), x[:, modes])
    alone = problem.with_model(held).holding(NOTHING).with_tolerance(ON_THE_WAY)
    found = solve(alone, x, max_iterations=20).values
    return torch.where(torch.isfinite(found), found, x)


def _still_ahead(step: float, before: float) -> float:
    """What further steps will add up to, if they go on to shrink as the last one did; else the last one."""
    return step**2 / (before - step) if step < before < math.inf else step


def _with_prior(parameters, values, gradient, information):
    """Gradient and information with the Gaussian priors of the shared parameters."""
    mean = torch.tensor([p.prior_mean for p in parameters], dtype=torch.float64)
    precision = torch.tensor([p.prior_sigma for p in parameters], dtype=torch.float64) ** -2
    return gradient + precision * (values - mean), information + torch.diag(precision)


def _reduced(problem: ImageFit, x: torch.Tensor):
    """Gradient and information of the shared parameters with the per-image ones eliminated.

    Both in units of the misfit, χ²/ν where it is above 1.
    """
    size = len(problem.held)
    gradient = torch.zeros(size, dtype=torch.float64)
    information = torch.zeros(size, size, dtype=torch.float64)
    chi2, own = 0.0, problem.layout.size
    for part, which in zip(x.split(8), torch.arange(len(x)).split(8), strict=True):
        columns, residual = _whitened_columns(problem, part, which)
        force, normal = (columns @ residual[..., None]).cpu(), (columns @ columns.mT).cpu()
        normal[:, :own, :own] += torch.diag_embed(problem.prior_precision[which])
        right = torch.cat([normal[:, :own, own:], force[:, :own]], dim=2)
        eliminated = normal[:, own:, :own] @ (scaled_inverse(normal[:, :own, :own]) @ right)
        gradient -= (force[:, own:, 0] - eliminated[..., -1]).sum(0)
        information += (normal[:, own:, own:] - eliminated[..., :-1]).sum(0)
        chi2 += float(residual.square().sum())
    misfit = max(1.0, chi2 / (problem.freedom * len(x)))
    return gradient / misfit, information / misfit


def _whitened_columns(problem: ImageFit, x: torch.Tensor, which: torch.Tensor):
    """Derivatives (b, own + shared, pixels) and residuals (b, pixels), both over the noise."""
    image, columns = problem.predict_and_all_derivatives(x)
    modes, shared = len(problem.layout.nolls), len(problem.held)
    order = [*range(modes), -2, -1, *range(modes, modes + shared)]
    which = which.to(problem.images.device)
    root = problem.root_weight[which, 0].double()
    residual = (problem.images[which, 0].double() - image) * root
    return columns[:, order].double() * root[:, None], residual
