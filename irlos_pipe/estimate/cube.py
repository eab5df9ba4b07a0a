"""The frames of a calibration cube, and how well their mean is known."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from irlos_pipe.estimate.steady import Motion
from irlos_pipe.frames.blocks import frame_flux, frame_variance, mean_frame
from irlos_pipe.frames.noise import NoiseModel

FRAMES_OF_SCATTER = 16  # whose scatter says how uncertain their mean is; of fewer, the noise model does
LOCAL_PX = 5  # side of the square over which scatter is averaged


@dataclass(frozen=True)
class Frames:
    """Images of a calibration cube.

    Attributes
    ----------
    images_e : tensor, (frames, rows, columns)
    good : tensor of bool, (rows, columns)
        True for good pixels.
    noise : NoiseModel
    misfit : float
        By which the variance of the mean is larger than that, because a model misfits (see `few_frames`).
    motion : Motion or None
        Of the star before the frames were `steadied`; None where it did not move.
    """

    images_e: torch.Tensor
    good: torch.Tensor
    noise: NoiseModel
    misfit: float = 1.0
    motion: Motion | None = None

    @cached_property
    def mean_e(self) -> torch.Tensor:
        """Mean image, (rows, columns), float64."""
        return torch.from_numpy(mean_frame(self.images_e.numpy()))

    @cached_property
    def scatter_e2(self) -> torch.Tensor:
        """Sample variance between the images, (rows, columns), float64."""
        return torch.from_numpy(frame_variance(self.images_e.numpy(), self.mean_e.numpy()))

    @cached_property
    def noise_ratio(self) -> float:
        """Scatter between the frames over the noise as told, median of the pixels; NaN of a single frame.

        Speckles and image motion add to the noise, nothing takes from it: a ratio well below 1 contradicts
        gain or read noise.
        """
        if len(self.images_e) < 2:
            return float("nan")
        ratio = self.scatter_e2 / self.noise.scatter_e2(self.mean_e)
        return float(ratio[self.good].nanmedian())

    @property
    def show_scatter(self) -> bool:
        """Whether the frames are enough to tell the errors of their mean from their scatter."""
        return len(self.images_e) >= FRAMES_OF_SCATTER

    @property
    def flux_e(self) -> torch.Tensor:
        """Signal of each image, (frames,), float64."""
        return torch.from_numpy(frame_flux(self.images_e.numpy()))


def mean_variance_e2(frames: Frames) -> torch.Tensor:
    """Variance of the mean image [e-²], (rows, columns): the scatter between frames, and what they share.

    The ratio of scatter to photon noise is averaged over 5×5 pixels, about λ/D, before it is held
    above one: pixel by pixel, scatter from few frames is uncertain, and its excursions would raise
    the variance and lower χ². A single frame has no scatter: its noise is that of the noise model.
    """
    photons = frames.noise.scatter_e2(frames.mean_e)
    if len(frames.images_e) == 1:
        return frames.misfit * (photons + frames.noise.shared_e2)
    ratio = local_mean(frames.scatter_e2 / photons, frames.good.double())
    own = photons * ratio.clamp_min(1.0) / len(frames.images_e)
    return frames.misfit * (own + frames.noise.shared_e2)


def local_mean(values: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Average `values` by `weight` over `LOCAL_PX` × `LOCAL_PX` pixels, (rows, columns)."""
    kernel = torch.ones(1, 1, LOCAL_PX, LOCAL_PX, dtype=values.dtype)
    total, norm = (
        torch.nn.functional.conv2d(plane[None, None], kernel, padding=LOCAL_PX // 2)[0, 0]
        for plane in (torch.where(weight > 0, values * weight, 0.0), weight)
    )
    return total / norm.clamp_min(1.0)


def autocorrelation_time(series: np.ndarray) -> np.ndarray:
    """Return the integrated autocorrelation time of every column, in frames.

    ``τ = 1 + 2 Σ ρ(l)``, summed in pairs of lags until a pair is no longer positive
    (initial positive sequence, Geyer 1992, Stat. Sci. 7, 473); at least 1.

    Parameters
    ----------
    series : ndarray, (frames, columns)

    Returns
    -------
    ndarray, (columns,)
    """
    frames = len(series)
    if frames < 4:
        return np.ones(series.shape[1])
    centred = series - series.mean(axis=0)
    spectrum = np.abs(np.fft.rfft(centred, n=2 * frames, axis=0)) ** 2
    covariance = np.fft.irfft(spectrum, axis=0)[:frames]
    rho = covariance / np.where(covariance[0] > 0, covariance[0], 1)
    pairs = rho[1:-1:2][: frames // 4] + rho[2::2][: frames // 4]
    positive = np.cumprod(pairs > 0, axis=0)
    return np.maximum(1 + 2 * np.sum(pairs * positive, axis=0), 1)


def covariance_of_mean(series: np.ndarray) -> np.ndarray:
    """Return the covariance of the mean of correlated rows, (columns, columns).

    The sample covariance over N, each column's error inflated by the root of its
    autocorrelation time.

    Raises
    ------
    ValueError
        With fewer than two rows.
    """
    if len(series) < 2:
        raise ValueError("the scatter of a mean needs at least two frames")
    inflation = np.sqrt(autocorrelation_time(series))
    covariance = np.atleast_2d(np.cov(series, rowvar=False)) / len(series)
    return covariance * inflation[:, None] * inflation[None, :]
