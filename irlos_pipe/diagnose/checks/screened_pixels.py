"""Pixels that the screening of the frames masked and no map lists: is their signal not the star's?

They are no part of any fit. Their raw mean against the prediction of a model that knows nothing of them
says whether they are bad, and what the gap would have been with them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from irlos_pipe.diagnose.checks.bad_pixels import OUTSTANDING
from irlos_pipe.diagnose.held_out import Gap
from irlos_pipe.diagnose.optimum import Optimum
from irlos_pipe.diagnose.significance import gaussian_sigma
from irlos_pipe.diagnose.verdict import Step
from irlos_pipe.diagnose.view import Screened
from irlos_pipe.effects import FixedEffect
from irlos_pipe.effects.pixels import BadPixels

OFF = 0.1  # of the star's signal in the pixel, below which the model may be to blame


def screened_step(screened: Sequence[Screened], optimum: Optimum, frames: int, gap: Gap) -> Step | None:
    """The step for those of the pixels whose mean is not what the model predicts; None if all agree.

    Parameters
    ----------
    screened : sequence of Screened
    optimum : Optimum
        Of the model at the end, its first recording that of the pixels.
    frames : int
        Over which the means were taken.
    gap : Gap
        Without the pixels.
    """
    window, stack = optimum.fitted.problem.window, optimum.stack.parts[0]
    star_e = optimum.fitted.image_e[optimum.fitted.problem.pixels[0]]
    sigma_e = stack.frames.noise.mean_variance_e2(star_e, frames).sqrt().reshape(window)
    off = [(one, one.mean_e - float(star_e.reshape(window)[one.row, one.column])) for one in screened]
    pulls = {one: miss / float(sigma_e[one.row, one.column]) for one, miss in off}
    bad = [
        (one, miss)
        for one, miss in off
        if pulls[one] ** 2 > OUTSTANDING and abs(miss) > OFF * abs(one.mean_e - miss)
    ]
    if not bad:
        return None
    effect = BadPixels([(one.row, one.column) for one, _ in bad])
    significance = gaussian_sigma(sum(pulls[one] ** 2 for one, _ in bad), len(bad), np.inf, len(star_e))
    nothing = np.zeros(len(bad))
    sigma = {"pixels": [[0.0, 0.0] for _ in bad]}
    before = _gap_with(gap.before, float(star_e.sum()), bad)
    found = Gap(before, gap.before, gap.floor)
    return Step(
        FixedEffect(effect, nothing), effect.describe(nothing), sigma, significance, np.nan, np.nan, found
    )


def _gap_with(gap: float, light_e: float, bad: Sequence[tuple[Screened, float]]) -> float:
    """The gap of a window of so much light, with pixels that miss by so much in it."""
    missing = sum(abs(miss) for _, miss in bad)
    return (gap * light_e + missing) / (light_e + sum(max(one.mean_e, 0.0) for one, _ in bad))
