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

SCAN_NM = np.linspace(-700.0, 700.0, 29)


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
    templates = model.images(coefficients, optics).cpu()
    best, shift_px = _most_alike(_standardised(templates), _standardised(images_e * pixel_mask))
    start = torch.zeros(len(images_e), len(model.nolls), dtype=torch.float64)
    start[:, focus] = torch.as_tensor(SCAN_NM)[best]
    pixel_nm = model.settings.pixel_scale_mas * MAS * model.settings.geometry.diameter_m * TILT_NM_PER_RAD
    for axis, noll in ((1, 2), (0, 3)):
        start[:, model.nolls.index(noll)] = shift_px[:, axis] * pixel_nm
    return start


def _standardised(images: torch.Tensor) -> torch.Tensor:
    """Images without mean and of unit norm, float32: correlations are compared with each other only."""
    centred = images.float() - images.float().mean((1, 2), keepdim=True)
    return centred / centred.square().sum((1, 2), keepdim=True).sqrt().clamp_min(1e-30)


def _most_alike(templates: torch.Tensor, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Template of the highest correlation with each image (images,), and its shift (images, 2) [px]."""
    spectra, (rows, columns) = torch.fft.rfft2(templates).conj(), images.shape[1:]
    best, peaks = [], []
    for image in images:
        correlation = torch.fft.irfft2(torch.fft.rfft2(image) * spectra, s=(rows, columns)).flatten(1)
        best.append(int(correlation.amax(1).argmax()))
        peak = int(correlation[best[-1]].argmax())
        peaks.append([_signed(peak // columns, rows), _signed(peak % columns, columns)])
    return torch.tensor(best), torch.tensor(peaks, dtype=torch.float64)


def _signed(index: int, size: int) -> int:
    """Shift that an index of a circular correlation stands for."""
    return index - size if index > size // 2 else index
