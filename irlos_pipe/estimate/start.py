"""A start for LIFT that needs no prior: the best of a scan of defocus, position free.

One template per defocus is shared by all images; the position comes from the peak of the
normalised cross-correlation. It costs a few transforms per image and does not care how far off
the elongation prior is.
"""

from __future__ import annotations

import numpy as np
import torch

from irlos_pipe.conventions.units import MAS
from irlos_pipe.estimate.centring import TILT_NM_PER_RAD
from irlos_pipe.optics.grids import Optics
from irlos_pipe.optics.psf import AS_BUILT, PsfModel

SCAN_NM = np.linspace(-700.0, 700.0, 15)


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
    best, shift_px = _most_alike(templates, images_e, pixel_mask)
    start = torch.zeros(len(images_e), len(model.nolls), dtype=torch.float64)
    start[:, focus] = torch.as_tensor(SCAN_NM)[best]
    pixel_nm = model.settings.pixel_scale_mas * MAS * model.settings.geometry.diameter_m * TILT_NM_PER_RAD
    for axis, noll in ((1, 2), (0, 3)):
        start[:, model.nolls.index(noll)] = shift_px[:, axis] * pixel_nm
    return start


def _standardised(images: torch.Tensor) -> torch.Tensor:
    """Images (..., rows, columns) without mean and of unit norm, float32: their correlations are compared."""
    centred = images.float() - images.float().mean((-2, -1), keepdim=True)
    return centred / torch.linalg.vector_norm(centred, dim=(-2, -1), keepdim=True).clamp_min(1e-30)


def _most_alike(
    templates: torch.Tensor, images: torch.Tensor, pixel_mask: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Template of the highest correlation with each image (images,), and its shift (images, 2) [px]."""
    rows, columns = pixel_mask.shape
    spectra = torch.fft.rfft2(_standardised(templates)).conj_physical()
    best, peaks = [], []
    for image in images:
        spectrum = torch.fft.rfft2(_standardised(image * pixel_mask))
        correlation = torch.fft.irfft2(spectrum * spectra, s=(rows, columns)).flatten(1)
        best.append(int(correlation.amax(1).argmax()))
        row, column = divmod(int(correlation[best[-1]].argmax()), columns)
        peaks.append([_signed(row, rows), _signed(column, columns)])
    return torch.tensor(best), torch.tensor(peaks, dtype=torch.float64)


def _signed(index: int, size: int) -> int:
    """Shift that an index of a circular correlation stands for."""
    return index - size if index > size // 2 else index
