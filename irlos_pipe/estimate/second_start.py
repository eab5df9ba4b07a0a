"""A second start for the fit of a mean image that ended in a wrong minimum.

Aberrations of 200 nm and more leave an averaged image with several minima, and a fit that
starts from none of them often ends in the wrong one, with χ²/ν ten times too large. Single frames
keep their speckles and are less ambiguous; the median of a few of them is a start close enough.
"""

from __future__ import annotations

import torch

from irlos_pipe.effects.image_model import ImageModel
from irlos_pipe.estimate.centring import start_tilts_nm
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.estimate.lift import LiftOptions, lift
from irlos_pipe.frames.noise import NoiseModel
from irlos_pipe.numerics.levenberg_marquardt import INVALID, Solution
from irlos_pipe.optics.psf import PsfModel

PLAUSIBLE_CHI2 = 4.0  # χ²/ν of right solutions stays below 3, that of wrong ones is 10 and more
FRAMES = 10
HIGHEST_NOLL = 30
MAX_ITERATIONS = 60


def is_plausible(problem: ImageFit, solution: Solution) -> bool:
    """Whether the first member of a problem is converged and fits."""
    return bool(solution.converged[0] and problem.reduced_chi2(solution.values[:1])[0] < PLAUSIBLE_CHI2)


def median_of_frames_nm(
    model: PsfModel,
    images_e: torch.Tensor,
    pixel_mask: torch.Tensor,
    noise: NoiseModel,
    max_iterations: int = MAX_ITERATIONS,
) -> torch.Tensor:
    """Median of the coefficients of a few frames spread over a cube, each fitted by itself.

    Parameters
    ----------
    model : PsfModel
        With Noll 2 and 3 as its first modes.
    images_e : tensor, (frames, rows, columns)

    Returns
    -------
    tensor, (modes,), float64 [nm RMS]
        Zero where no frame could be fitted.
    """
    chosen = torch.linspace(0, len(images_e) - 1, min(FRAMES, len(images_e))).round().long()
    some = images_e[chosen]
    start = torch.zeros(len(some), len(model.nolls), dtype=torch.float64)
    scale, diameter = model.settings.pixel_scale_mas, model.settings.geometry.diameter_m
    start[:, :2] = start_tilts_nm((some * pixel_mask).double(), scale, diameter)
    options = LiftOptions(noise="data", max_iterations=max_iterations)
    result = lift(ImageModel(model), some, pixel_mask, noise, start, options)
    valid = torch.tensor([status != INVALID for status in result.solution.status])
    estimates = result.zernike_nm[valid]
    return estimates.median(dim=0).values if len(estimates) else start.new_zeros(len(model.nolls))


def better(first: Solution, second: Solution) -> Solution:
    """The solution of the same problem with the lower objective; a valid one before an invalid one."""
    if second.status[0] == INVALID or first.status[0] == INVALID:
        return first if second.status[0] == INVALID else second
    return second if second.objective[0] < first.objective[0] else first
