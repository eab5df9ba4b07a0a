"""What the correction would buy: images with and without the measured aberrations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from irlos_pipe.optics.grids import Optics
from irlos_pipe.optics.psf import PsfModel
from irlos_pipe.optics.psf_settings import KnownWavefront, PsfSettings


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
    nolls: Sequence[int],
    modes_nm: np.ndarray,
    total_nm: np.ndarray,
    gain: np.ndarray,
    make_optics: Callable[[PsfModel], Optics],
) -> Prediction:
    """Images before and after a correction; tip and tilt are left out of both.

    Parameters
    ----------
    modes_nm, total_nm : ndarray, (modes,)
        Modes that go with the effects of `make_optics`, and those of the whole wavefront, which is what
        is corrected.
    gain : ndarray, (modes,)
        Part of each mode that is taken out.
    make_optics : callable
        ``make_optics(model)`` gives what AO residual, jitter and other effects make of the light path.
    """
    model = PsfModel(replace(settings, known=KnownWavefront()), nolls)
    motion = np.isin(nolls, (2, 3))
    before = np.where(motion, modes_nm - total_nm, modes_nm)
    after = np.where(motion, before, modes_nm - gain * total_nm)
    wavefronts = torch.as_tensor(np.stack([before, after]))
    images = model.images(wavefronts, make_optics(model)).double().numpy()
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
