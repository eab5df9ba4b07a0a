"""Where the star is: the start of tip and tilt."""

from __future__ import annotations

import torch

from irlos_pipe.conventions.units import MAS

TILT_NM_PER_RAD = 1e9 / 4  # a tilt θ over the diameter D is θ D/4 RMS


def start_tilts_nm(images_e: torch.Tensor, pixel_scale_mas: float, diameter_m: float) -> torch.Tensor:
    """Tip and tilt that move the model to the centroid of the bright pixels, (frames, 2) [nm RMS].

    Pixels below a fifth of the brightest are left out, so that noise and halo do not pull.

    Parameters
    ----------
    images_e : tensor, (frames, rows, columns)
    """
    bright = (images_e - 0.2 * images_e.amax((1, 2), keepdim=True)).clamp_min(0)
    total = bright.sum((1, 2)).clamp_min(1e-30)
    rows, columns = images_e.shape[1:]
    y = (bright.sum(2) @ (torch.arange(rows, dtype=bright.dtype) - (rows - 1) / 2)) / total
    x = (bright.sum(1) @ (torch.arange(columns, dtype=bright.dtype) - (columns - 1) / 2)) / total
    return torch.stack([x, y], dim=1).double() * pixel_scale_mas * MAS * diameter_m * TILT_NM_PER_RAD
