"""The frames of a calibration cube, and how well their mean is known."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..noise import NoiseModel

LOCAL_PX = 5  # side of the square over which scatter is averaged


@dataclass(frozen=True)
class Frames:
    """Images of a calibration cube.

    Attributes
    ----------
    images_e : tensor, (frames, rows, columns)
    pixel_mask : tensor of bool, (rows, columns)
        True for good pixels.
    noise : NoiseModel
    """

    images_e: torch.Tensor
    pixel_mask: torch.Tensor
    noise: NoiseModel


def mean_variance_e2(frames: Frames) -> torch.Tensor:
    """Variance of the mean image [e-²], (rows, columns): the scatter between frames, and what they share.

    The ratio of scatter to photon noise is averaged over 5×5 pixels, about λ/D, before it is held
    above one: pixel by pixel, scatter from few frames is uncertain, and its excursions would raise
    the variance and lower χ².
    """
    images = frames.images_e.double()
    photons = frames.noise.scatter_e2(images.mean(0))
    ratio = local_mean(images.var(0, correction=1) / photons, frames.pixel_mask.double())
    return photons * ratio.clamp_min(1.0) / len(images) + frames.noise.shared_e2


def local_mean(values: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Weighted running mean over `LOCAL_PX` × `LOCAL_PX` pixels, (rows, columns)."""
    kernel = torch.ones(1, 1, LOCAL_PX, LOCAL_PX, dtype=values.dtype)
    total, norm = (
        torch.nn.functional.conv2d(plane[None, None], kernel, padding=LOCAL_PX // 2)[0, 0]
        for plane in (torch.where(weight > 0, values * weight, 0.0), weight)
    )
    return total / norm.clamp_min(1.0)
