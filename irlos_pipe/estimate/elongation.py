"""Defocus prior from the elongation that an astigmatic diversity gives a defocused image.

A 2-D Gaussian with axes along those of the diversity is fitted to every image, and
``defocus = A (σ1/σ2 - 1) + B``. A and B come from the PSF model of the instrument at hand, sign of the
diversity included, and hold inside a stated range.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from irlos_pipe.numerics.parallel import joined_map
from irlos_pipe.numerics.solver import Problem, Solution, solve
from irlos_pipe.optics.grids import Optics
from irlos_pipe.optics.light_path import AS_BUILT
from irlos_pipe.optics.psf import PsfModel

SPAN_NM = np.linspace(-400.0, 400.0, 33)  # defocus scanned for the calibration of A and B
IMAGES_AT_ONCE = 16  # their derivatives, 3 MiB, stay in the cache, and the allocator keeps such pieces
TOLERANCE_NM = 60.0  # the validity range ends where the linear law errs by more


@dataclass(frozen=True)
class ElongationLaw:
    """``defocus_nm = A (ratio - 1) + B``; A and B in nm RMS."""

    A: float
    B: float
    angle_deg: float  # direction of the first axis, from +x towards +y
    valid_nm: tuple[float, float]  # defocus for which the law errs by less than `TOLERANCE_NM`
    residual_nm: float  # RMS error of the law inside the range

    def defocus_nm(self, ratio: np.ndarray) -> np.ndarray:
        """Return the prior defocus of axis ratios σ1/σ2, clipped to a little beyond the validity range."""
        low, high = self.valid_nm
        reach = 0.25 * (high - low)
        return np.clip(self.A * (np.asarray(ratio) - 1) + self.B, low - reach, high + reach)


def diversity_angle_deg(diversity_nm: Mapping[int, float]) -> float:
    """Return the axis of the astigmatic diversity: 0° for Noll 6, 45° for Noll 5, between for a mixture.

    Raises ValueError without astigmatism in the diversity: an image does not show the sign of defocus then.
    """
    oblique, vertical = diversity_nm.get(5, 0.0), diversity_nm.get(6, 0.0)
    if oblique == 0 and vertical == 0:
        raise ValueError("the elongation prior needs an astigmatic diversity (Noll 5 or 6)")
    return float(np.rad2deg(np.arctan2(oblique, vertical)) / 2 % 90)


class GaussianFit(Problem):
    """Rotated 2-D Gaussians fitted to images, for `solve`.

    Parameters are x, y [px], ln σ1, ln σ2 [px], amplitude, background; every image in units of
    its own brightest pixel, all pixels with the same weight.
    """

    def __init__(self, images_e: torch.Tensor, good: torch.Tensor, angle_deg: float):
        rows, columns = images_e.shape[1:]
        peak = (images_e * good).amax((1, 2)).clamp_min(1e-30)
        self.images = (images_e / peak[:, None, None]).double().flatten(1)
        self.weight = good.double().flatten()
        y, x = torch.meshgrid(
            torch.arange(rows) - (rows - 1) / 2, torch.arange(columns) - (columns - 1) / 2, indexing="ij"
        )
        self.x, self.y = x.double().flatten(), y.double().flatten()
        self.cos, self.sin = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
        widest = float(np.log(max(rows, columns)))
        reach = max(rows, columns) / 2
        self.lower = torch.tensor([-reach, -reach, -1.0, -1.0, 0.0, -1.0], dtype=torch.float64)
        self.upper = torch.tensor([reach, reach, widest, widest, 3.0, 1.0], dtype=torch.float64)

    def start(self) -> torch.Tensor:
        """Return the centroid and width of the pixels above a third of the peak."""
        bright = (self.images - 1 / 3).clamp_min(0) * self.weight
        total = bright.sum(1).clamp_min(1e-12)
        x, y = (bright @ self.x) / total, (bright @ self.y) / total
        area = (bright > 0).double().sum(1).clamp_min(4.0)
        width = torch.log((area / np.pi).sqrt())
        return torch.stack([x, y, width, width, torch.full_like(x, 0.8), torch.zeros_like(x)], dim=1)

    def objective(self, p: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
        """See `Problem.objective`: half the sum of squared residuals."""
        return self.normal_equations(p, which)[0]

    def negligible(self, value: torch.Tensor) -> torch.Tensor:
        """Return a millionth of the sum of squares, which may vanish: there is no noise model here."""
        return 1e-6 * value.clamp_min(1e-6)

    def normal_equations(self, p: torch.Tensor, which: torch.Tensor):
        dx, dy = self.x - p[:, :1], self.y - p[:, 1:2]
        first = (dx * self.cos + dy * self.sin) * torch.exp(-p[:, 2:3])
        second = (dy * self.cos - dx * self.sin) * torch.exp(-p[:, 3:4])
        gauss = torch.exp(-0.5 * (first**2 + second**2))
        residual = self.images[which] - p[:, 4:5] * gauss - p[:, 5:6]
        body = p[:, 4:5] * gauss
        u, v = first * torch.exp(-p[:, 2:3]), second * torch.exp(-p[:, 3:4])
        columns = torch.stack(
            [
                body * (u * self.cos - v * self.sin),
                body * (u * self.sin + v * self.cos),
                body * first**2,
                body * second**2,
                gauss,
                torch.ones_like(gauss),
            ],
            dim=1,
        )
        weighted = columns * self.weight
        return (
            0.5 * (self.weight * residual**2).sum(1),
            -(weighted @ residual[..., None])[..., 0],
            weighted @ columns.mT,
        )


def fit_gaussians(images_e: torch.Tensor, good: torch.Tensor, angle_deg: float) -> Solution:
    """Fit a Gaussian with an axis at `angle_deg` to the good pixels `good` of all `images_e`."""
    problem = GaussianFit(images_e, good, angle_deg)
    return solve(problem, problem.start(), max_iterations=80)


@torch.no_grad()
def axis_ratios(images_e: torch.Tensor, good: torch.Tensor, angle_deg: float) -> np.ndarray:
    """Return the ratio σ1/σ2 of every image, (images,); NaN where the fit failed.

    The first axis points by `angle_deg` from +x towards +y; of `images_e` (images, rows, columns), the `good`
    pixels (rows, columns) count.
    """
    blocks = images_e.split(IMAGES_AT_ONCE)

    def ratios(block: torch.Tensor) -> tuple[torch.Tensor]:
        fit = fit_gaussians(block, good, angle_deg)
        return (torch.where(fit.converged, torch.exp(fit.values[:, 2] - fit.values[:, 3]), torch.nan),)

    return joined_map(ratios, blocks, len(images_e))[0].numpy()


def calibrate_law(model: PsfModel, optics: Optics = AS_BUILT) -> ElongationLaw:
    """Calibrate A and B with images of a `model` of Noll 4 alone over a range of defocus.

    What effects make of the light path is in `optics`.
    """
    angle = diversity_angle_deg(model.settings.known.diversity_nm)
    images = model.images(torch.as_tensor(SPAN_NM)[:, None], optics).cpu()
    ratio = axis_ratios(images, torch.ones(images.shape[1:], dtype=torch.bool), angle)
    # a straight line through the widest range, symmetric about zero defocus, that it describes
    for reach in SPAN_NM[SPAN_NM > 100][::-1]:
        inside = (np.abs(SPAN_NM) <= reach) & np.isfinite(ratio)
        slope, offset = np.polyfit(ratio[inside] - 1, SPAN_NM[inside], 1)
        residual = slope * (ratio[inside] - 1) + offset - SPAN_NM[inside]
        if np.abs(residual).max() <= TOLERANCE_NM:
            break
    return ElongationLaw(
        float(slope),
        float(offset),
        angle,
        (-float(reach), float(reach)),
        float(np.sqrt(np.mean(residual**2))),
    )
