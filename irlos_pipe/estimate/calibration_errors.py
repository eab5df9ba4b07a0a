"""Errors of a calibration: from the scatter of the frames, grown by what the model misfits.

Too few frames say little of their scatter: their errors are those of the noise model (`few_frames`), and
where they scatter beyond it, as behind an AO system, those of the scatter besides, widened as Student's t
asks for three standard deviations.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.special import ndtr, stdtrit

from irlos_pipe.estimate.cube import Frames, covariance_of_mean
from irlos_pipe.estimate.few_frames import covariance_from_noise
from irlos_pipe.estimate.image_fit import ImageFit
from irlos_pipe.numerics.solution import Solution

ErrorsFrom = Literal["frames", "few_frames", "noise"]
SIGNIFICANT = 5.0  # standard deviations by which few frames have to scatter beyond noise
KEPT_SIGMA = 3.0  # at which the widened errors hold what they say


def errors_of(
    frames: Frames, problem: ImageFit, solution: Solution, frames_nm: np.ndarray, misfit: float
) -> tuple[np.ndarray, ErrorsFrom]:
    """Return the covariance of the modes [nm²], and where it comes from.

    Parameters
    ----------
    frames : Frames
    problem : ImageFit
    solution : Solution
        Of the problem.
    frames_nm : ndarray, (frames, modes)
        Estimates of single frames; NaN where a fit failed.
    misfit : float
        χ²/ν of the mean image over its nominal value: below 1 it says nothing, above it the variances grow.
    """
    used = frames_nm[np.isfinite(frames_nm).all(1)]
    if frames.show_scatter:
        return max(1.0, misfit) * covariance_of_mean(used), "frames"
    covariance = covariance_from_noise(problem, solution)
    if not _scatter_beyond(used, covariance):
        return covariance, "noise"
    return covariance + widening(len(used)) ** 2 * np.cov(used, rowvar=False) / len(used), "few_frames"


def _scatter_beyond(used: np.ndarray, covariance: np.ndarray) -> bool:
    """Whether the frames scatter by more than the noise model says, over all modes together."""
    count, modes = used.shape
    if count < 2:
        return False
    ratio = float(np.mean(used.var(axis=0, ddof=1) / count / np.diag(covariance)))
    return ratio > 1 + SIGNIFICANT * np.sqrt(2 / (modes * (count - 1)))


def widening(count: int) -> float:
    """Return the factor on the standard error of the mean of `count` values, which know little of it."""
    return float(stdtrit(count - 1, ndtr(KEPT_SIGMA))) / KEPT_SIGMA
