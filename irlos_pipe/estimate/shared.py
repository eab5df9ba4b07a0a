"""Parameters that all images of a ramp share: object size and AO residual, fitted jointly.

In one image the size of the object and the defocus are degenerate, which is why the paper tuned
the kernel by hand; on a ramp the defocus changes and the object does not. The per-image
parameters are eliminated from the joint normal equations by the Schur complement, so the cost is
that of LIFT plus one small system.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..effects.transfer import Transfer
from .image_fit import ImageFit
from .solve import CONVERGED, MAX_ITERATIONS, solve

OUTER_ITERATIONS = 12
STEP_SIGMA = 0.02  # converged when no shared parameter moves by more than this part of its error


@dataclass(frozen=True)
class SharedFit:
    """Shared effect parameters with their covariance, and the per-image parameters at the optimum.

    Attributes
    ----------
    values : tensor, (shared,)
    covariance : tensor, (shared, shared)
        Per-image parameters marginalised.
    x : tensor, (images, parameters)
    status : str
    """

    values: torch.Tensor
    covariance: torch.Tensor
    x: torch.Tensor
    status: str


def fit_shared(problem: ImageFit, transfer: Transfer, x: torch.Tensor) -> SharedFit:
    """Fit the free parameters of `transfer` to all images of `problem` together.

    Parameters
    ----------
    problem : ImageFit
        One parameter vector per image; its own transfer is replaced on the way.
    transfer : Transfer
        With at least one free parameter.
    x : tensor, (images, parameters)
        Start of the per-image parameters.

    Returns
    -------
    SharedFit
    """
    limits = torch.tensor([[p.lower, p.upper] for p in transfer.parameters], dtype=torch.float64)
    values = torch.tensor([p.start for p in transfer.parameters], dtype=torch.float64)
    status = MAX_ITERATIONS
    for _ in range(OUTER_ITERATIONS):
        problem.transfer = transfer(values).to(problem.model.device, problem.model.dtype)
        x = solve(problem, x, max_iterations=20).values
        gradient, information = _reduced(problem, transfer, values, x)
        covariance = torch.linalg.inv(information)
        trial = (values - covariance @ gradient).clamp(limits[:, 0], limits[:, 1])
        small = ((trial - values).abs() / torch.diagonal(covariance).sqrt()).max() < STEP_SIGMA
        values = trial
        if small:
            status = CONVERGED
            break
    return SharedFit(values, covariance, x, status)


def _reduced(problem: ImageFit, transfer: Transfer, values: torch.Tensor, x: torch.Tensor):
    """Gradient and information of the shared parameters with the per-image ones eliminated."""
    derivatives = transfer.derivatives(values).to(problem.model.device, problem.model.dtype)
    gradient = torch.zeros(len(values), dtype=torch.float64)
    information = torch.zeros(len(values), len(values), dtype=torch.float64)
    own = problem.layout.size
    for part, which in zip(x.split(8), torch.arange(len(x)).split(8), strict=True):
        columns, residual = _whitened_columns(problem, derivatives, part, which)
        force, normal = columns @ residual[..., None], columns @ columns.mT
        normal[:, :own, :own] += torch.diag_embed(problem.prior_precision[which]).to(normal.device)
        inner = torch.linalg.solve(
            normal[:, :own, :own], torch.cat([normal[:, :own, own:], force[:, :own]], dim=2)
        )
        eliminated = normal[:, own:, :own] @ inner
        gradient -= (force[:, own:, 0] - eliminated[..., -1]).sum(0).cpu()
        information += (normal[:, own:, own:] - eliminated[..., :-1]).sum(0).cpu()
    return gradient, information


def _whitened_columns(problem: ImageFit, derivatives: torch.Tensor, x: torch.Tensor, which: torch.Tensor):
    """Derivatives (b, own + shared, pixels) and residuals (b, pixels), both over the noise."""
    x = x.to(problem.model.device)
    unit, jacobian = problem.model.images_and_jacobian(
        x[:, problem.layout.modes], problem.transfer, derivatives
    )
    unit, jacobian = unit.double().flatten(1), jacobian.double().flatten(2)
    modes, flux = len(problem.layout.nolls), x[:, -2, None, None]
    columns = torch.cat(
        [
            jacobian[:, :modes] * flux,
            unit[:, None],
            torch.ones_like(unit)[:, None],
            jacobian[:, modes:] * flux,
        ],
        dim=1,
    )
    which = which.to(problem.images.device)
    root = problem.root_weight[which, 0].double()
    residual = (problem.images[which, 0].double() - x[:, -2:-1] * unit - x[:, -1:]) * root
    return columns * root[:, None], residual
