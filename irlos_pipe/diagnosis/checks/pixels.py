"""Single pixels that are bad: those that stand out of the residual, and those that ingest has masked.

The former are looked for where the model explains their neighbours well. The latter are no part of any
fit: their mean against the prediction of a model without them says whether they are bad, and what the gap
would have been with them.
"""

from collections.abc import Sequence

import numpy as np
import torch

from irlos_pipe.diagnosis.null_model import FittedModel, Optimum, gaussian_sigma, surely_exceeding
from irlos_pipe.diagnosis.records import Gap
from irlos_pipe.diagnosis.scores import Family
from irlos_pipe.diagnosis.verdict import Step
from irlos_pipe.diagnosis.view import Screened
from irlos_pipe.effects import FixedEffect
from irlos_pipe.effects.detector import BadPixels

OUTSTANDING = 50.0  # fall of χ² by a pixel's own offset: 7 σ, one of some thousand pixels
ALONE = 4.0  # times the largest residual of the neighbours, above which a pixel stands alone
MOST = 20  # pixels of the family at most

OFF = 0.1  # part of the star's signal in the pixel, below which the model may be to blame


def outstanding_pixels(optimum: FittedModel) -> list[tuple[int, int]]:
    """(row, column) of the pixels that nothing smooth explains, the worst first."""
    problem = optimum.fitted.problem
    left = 1 - (optimum.basis**2).sum(1)
    pulls = (optimum.residual / left.clamp_min(1e-6).sqrt()).abs().reshape(-1, *problem.window)
    pull = pulls.amax(0)
    # The largest of the eight neighbours of every pixel.
    rows, columns = pull.shape
    padded = torch.nn.functional.pad(pull[None, None], (1, 1, 1, 1))[0, 0]
    shifted = [padded[r : r + rows, c : c + columns] for r in range(3) for c in range(3) if (r, c) != (1, 1)]
    around = torch.stack(shifted).amax(0)
    chosen = (pull**2 > OUTSTANDING) & (pull > ALONE * around)
    found = torch.nonzero(chosen)[pull[chosen].argsort(descending=True)]
    return [(int(row), int(column)) for row, column in found[:MOST]]


def smallest_excess(optimum: Optimum) -> dict[str, dict[str, float]]:
    """Excess of a pixel that would surely stand out, median over the window [e-], under the effect's name."""
    error = optimum.stack.variance_e2.sqrt()
    pull = surely_exceeding(OUTSTANDING, 1) ** 0.5
    return {BadPixels.name: {"excess_e": float(pull * error[error.isfinite()].median())}}


def bad_pixel_family(optimum: FittedModel) -> list[Family]:
    """The joint family of these pixels; none where there are none, or where the model lists some."""
    if any(effect.found_by == "pixels" for effect in optimum.fitted.effects):
        return []
    pixels = outstanding_pixels(optimum)
    looked_at = int((optimum.root > 0).sum())
    return [Family((BadPixels(pixels),), looked_at)] if pixels else []


def screened_step(screened: Sequence[Screened], optimum: Optimum, frames: int, gap: Gap) -> Step | None:
    """The step for those of the pixels whose mean is not what the model predicts; None if all agree.

    The first recording of the `optimum` is that of the pixels, whose means are those of so many `frames`;
    `gap` is that without them.
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
    # the gap of the window with the pixels in it
    light_e, missing_e = float(star_e.sum()), sum(abs(miss) for _, miss in bad)
    whole_e = light_e + sum(max(one.mean_e, 0.0) for one, _ in bad)
    found = Gap((gap.before * light_e + missing_e) / whole_e, gap.before, gap.floor)
    return Step(
        FixedEffect(effect, nothing), effect.describe(nothing), sigma, significance, np.nan, np.nan, found
    )
