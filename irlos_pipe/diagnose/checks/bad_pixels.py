"""Single pixels that stand out of the residual, their neighbours being well explained."""

from __future__ import annotations

import torch

from irlos_pipe.diagnose.optimum import Optimum
from irlos_pipe.diagnose.search.families import Family
from irlos_pipe.effects.pixels import BadPixels

OUTSTANDING = 50.0  # fall of χ² by a pixel's own offset: 7 σ, one of some thousand pixels
ALONE = 4.0  # times the largest residual of the neighbours
MOST = 20


def outstanding_pixels(optimum: Optimum) -> list[tuple[int, int]]:
    """(row, column) of the pixels that nothing smooth explains, the worst first."""
    problem = optimum.fitted.problem
    left = 1 - (optimum.basis**2).sum(1)
    pulls = (optimum.residual / left.clamp_min(1e-6).sqrt()).abs().reshape(-1, *problem.window)
    pull = pulls.amax(0)
    around = _largest_neighbour(pull)
    chosen = (pull**2 > OUTSTANDING) & (pull > ALONE * around)
    found = torch.nonzero(chosen)[pull[chosen].argsort(descending=True)]
    return [(int(row), int(column)) for row, column in found[:MOST]]


def smallest_excess(optimum: Optimum) -> dict[str, dict[str, float]]:
    """Excess of a single pixel that would stand out, median over the window [e-], under the effect's name."""
    error = optimum.stack.variance_e2.sqrt()
    return {BadPixels.name: {"excess_e": float(OUTSTANDING**0.5 * error[error.isfinite()].median())}}


def bad_pixel_family(optimum: Optimum) -> list[Family]:
    """The family of these pixels together; none where there are none."""
    pixels = outstanding_pixels(optimum)
    looked_at = int((optimum.root > 0).sum())
    return [Family((BadPixels(pixels),), looked_at)] if pixels else []


def _largest_neighbour(image: torch.Tensor) -> torch.Tensor:
    """Largest of the eight neighbours."""
    rows, columns = image.shape
    padded = torch.nn.functional.pad(image[None, None], (1, 1, 1, 1))[0, 0]
    shifted = [padded[r : r + rows, c : c + columns] for r in range(3) for c in range(3) if (r, c) != (1, 1)]
    return torch.stack(shifted).amax(0)
