"""What the correction would buy: images with and without the measured aberrations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from ..psf import PsfModel, PsfSettings


@dataclass(frozen=True)
class Prediction:
    """Unit-flux images without diversity and their quality.

    Attributes
    ----------
    before, after, perfect : ndarray, (rows, columns)
        With all estimated aberrations; with the corrected modes removed; with none. AO residual and
        jitter are in the first two.
    strehl_before, strehl_after : float
        Peak over that of the aberration-free image, at the mean wavelength of the spectrum.
    radius_mas, profile_before, profile_after : ndarray, (radii,)
    """

    before: np.ndarray
    after: np.ndarray
    perfect: np.ndarray
    strehl_before: float
    strehl_after: float
    radius_mas: np.ndarray
    profile_before: np.ndarray
    profile_after: np.ndarray


def predict_correction(
    settings: PsfSettings,
    nolls,
    zernike_nm: np.ndarray,
    corrected: tuple[int, ...],
    gain: float,
    make_transfer,
) -> Prediction:
    """Images before and after removing the modes `corrected`; tip and tilt are left out of both.

    Parameters
    ----------
    gain : float
        Part of the corrected modes that is taken out.
    make_transfer : callable
        ``make_transfer(model)`` gives the fixed OTF factors of AO residual and jitter, or None.
    """
    model = PsfModel(replace(settings, diversity={}), nolls)
    before = torch.as_tensor(np.where(np.isin(nolls, (2, 3)), 0.0, zernike_nm))
    after = torch.as_tensor(np.where(np.isin(nolls, corrected), (1 - gain) * before, before))
    transfer = make_transfer(model)
    images = model.images(torch.stack([before, after]), transfer).double().numpy()
    perfect = model.images(torch.zeros(1, len(nolls)))[0].double().numpy()
    radius, profiles = _profiles(images, settings.pixel_scale_mas)
    peak = perfect.max()
    return Prediction(
        *images, perfect, float(images[0].max() / peak), float(images[1].max() / peak), radius, *profiles
    )


def _profiles(images: np.ndarray, pixel_scale_mas: float) -> tuple[np.ndarray, list[np.ndarray]]:
    """Azimuthal means in rings one pixel wide about the optical axis."""
    rows, columns = images.shape[1:]
    radius = np.hypot(
        np.arange(rows)[:, None] - (rows - 1) / 2, np.arange(columns)[None, :] - (columns - 1) / 2
    )
    ring = radius.astype(int)
    count = np.bincount(ring.ravel())
    inside = slice(0, min(rows, columns) // 2)
    profiles = [np.bincount(ring.ravel(), image.ravel())[inside] / count[inside] for image in images]
    return (np.bincount(ring.ravel(), radius.ravel()) / count)[inside] * pixel_scale_mas, profiles
