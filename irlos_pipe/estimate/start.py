"""A start for LIFT that needs no prior: the best of a scan of defocus, position free.

One template per defocus is shared by all images; the position comes from the peak of the
normalised cross-correlation. It costs a few transforms per image and does not care how far off
the elongation prior is.
"""

from __future__ import annotations

import numpy as np
import torch

from ..optics.grids import Optics
from ..optics.propagate import MAS
from ..psf import AS_BUILT, PsfModel
from .centring import TILT_NM_PER_RAD

SCAN_NM = np.linspace(-700.0, 700.0, 57)


def scan_start_nm(
    model: PsfModel, images_e: torch.Tensor, pixel_mask: torch.Tensor, optics: Optics = AS_BUILT
) -> torch.Tensor:
    """Tip, tilt and defocus of the template that resembles each image most, other modes 0.

    Parameters
    ----------
    model : PsfModel
        Noll 2, 3 and 4 among its modes.
    images_e : tensor, (images, rows, columns)

    Returns
    -------
    tensor, (images, modes), float64 [nm RMS]
    """
    focus = model.nolls.index(4)
    coefficients = torch.zeros(len(SCAN_NM), len(model.nolls), dtype=torch.float64)
    coefficients[:, focus] = torch.as_tensor(SCAN_NM)
    templates = model.images(coefficients, optics).cpu().double()
    correlation, shift = _best_shift(_standardised(templates), _standardised(images_e.double() * pixel_mask))
    best = correlation.argmax(1)
    start = torch.zeros(len(images_e), len(model.nolls), dtype=torch.float64)
    start[:, focus] = torch.as_tensor(SCAN_NM)[best]
    pixel_nm = model.settings.pixel_scale_mas * MAS * model.settings.geometry.diameter_m * TILT_NM_PER_RAD
    chosen = shift[torch.arange(len(best)), best].double() * pixel_nm
    for axis, noll in ((1, 2), (0, 3)):
        start[:, model.nolls.index(noll)] = chosen[:, axis]
    return start


def _standardised(images: torch.Tensor) -> torch.Tensor:
    """Images without mean and of unit norm."""
    centred = images - images.mean((1, 2), keepdim=True)
    return centred / centred.square().sum((1, 2), keepdim=True).sqrt().clamp_min(1e-30)


def _best_shift(templates: torch.Tensor, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Highest correlation (images, templates) and the shift (row, column) [px] that gives it."""
    spectra = torch.fft.rfft2(templates).conj()
    size = images.shape[1:]
    peaks, shifts = [], []
    for image in images:
        surface = torch.fft.irfft2(torch.fft.rfft2(image) * spectra, s=size).flatten(1)
        peak, index = surface.max(1)
        row, column = index // size[1], index % size[1]
        row = torch.where(row > size[0] // 2, row - size[0], row)
        column = torch.where(column > size[1] // 2, column - size[1], column)
        peaks.append(peak)
        shifts.append(torch.stack([row, column], dim=1))
    return torch.stack(peaks), torch.stack(shifts)
