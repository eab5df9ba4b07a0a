"""Structure of the mean image that is finer than a telescope can make.

Whatever the wavefront, light ends at the cut-off D/λ of spatial frequency (Goodman 2005, Introduction to
Fourier Optics, section 6.3); motion and pixels only weaken what is below. What a mean image has beyond, and
noise does not explain, was made behind the optics: by an error of the flat, by single pixels, by a response
that is not linear. Speckles do not reach there, so it shows down to photon noise on sky as well.

A model of the detector reaches beyond as well. What it has there and the data have not is its mistake, and no
structure of theirs: what counts is what the data have, and what the model leaves of it.
"""

import numpy as np
import torch

from irlos_pipe.conventions.units import cutoff_per_px
from irlos_pipe.diagnosis.cube import Stack
from irlos_pipe.diagnosis.null_model import Optimum
from irlos_pipe.diagnosis.records import FineStructure
from irlos_pipe.estimate.cube import local_mean
from irlos_pipe.optics.psf_settings import PsfSettings

MAIN_LOBE = 2  # half width of a Hann window's, in frequencies of the window: beyond it little leaks
FADED = 0.1  # of the window's middle, below which pixels are left out
REGRESSIONS, SURELY = 4, 5.0  # steps for the flat's error; standard errors from which it is believed
MIN_SHARE = 0.1  # of all frequencies; with less beyond the cut-off, pixels are too coarse to show any


def fine_structure(optimum: Optimum) -> FineStructure:
    """Fine structure that a fitted model does not explain, the most significant of its recordings.

    With pixels held out it cannot be told from the gaps they leave.
    """
    if optimum.stack.held_out == "pixels":
        return FineStructure()
    fitted = optimum.fitted
    found = [
        structure_of(part, fitted.image_e[pixels], view.psf.settings)
        for part, pixels, view in zip(optimum.stack.parts, fitted.problem.pixels, fitted.views, strict=True)
    ]
    return max(found, key=lambda one: one.significance)


def structure_of(stack: Stack, model_e: torch.Tensor, settings: PsfSettings) -> FineStructure:
    """Fine structure of one recording: the lesser of what it has and of what a model leaves of it.

    `model_e` is its mean image by the model [e-], (pixels,).
    """
    beyond = Beyond(stack.frames.good, highest_frequency_per_px(settings))
    if beyond.share < MIN_SHARE:
        return FineStructure()
    deviations_e = torch.where(stack.root > 0, stack.deviations / stack.root, 0.0)
    frames = beyond(deviations_e.reshape(-1, *settings.window)) ** 2
    scatter = local_mean(frames.sum(0) / (len(frames) - 1), beyond.weight)
    shared = beyond.share * beyond.fade**2 * stack.frames.noise.shared_e2
    left = beyond((stack.mean_e - model_e).reshape(1, *settings.window))[0]
    own = left + beyond.of_whole(model_e.reshape(settings.window))
    noise = (frames / scatter)[:, beyond.inside].mean(1) * len(frames) / (len(frames) - 1)
    means = [(part**2 / (scatter / len(frames) + shared))[beyond.inside].mean() for part in (left, own)]
    power = float(min(means))
    return FineStructure(power / float(noise.mean()), _significance(power, noise.numpy()))


def _significance(power: float, of_noise: np.ndarray) -> float:
    """Gaussian σ of a `power` against those that noise gives frames, (frames,).

    The power of noise is a χ² with few degrees, as bright pixels have most of it: its cube root is nearly
    normal (Wilson & Hilferty 1931, PNAS 17, 684). A further draw is judged by Student's t, as the Gaussian
    deviate of the same probability (Wallace 1959, Annals of Mathematical Statistics 30, 1121).
    """
    roots, degrees = np.cbrt(of_noise), len(of_noise) - 1
    t = (np.cbrt(power) - roots.mean()) / (roots.std(ddof=1) * np.sqrt(1 + 1 / len(roots)))
    sigma = (8 * degrees + 1) / (8 * degrees + 3) * np.sqrt(degrees * np.log1p(t**2 / degrees))
    return float(np.copysign(sigma, t))


def flat_rms(stack: Stack, residual_e: torch.Tensor, settings: PsfSettings) -> float:
    """Relative error of the flat that explains fine structure beyond noise; 0 where it is not significant.

    The squares of `residual_e`, the mean image minus that of a model [e-], (pixels,), filtered for what lies
    beyond the cut-off, are v + f² m² on average, with what the filter leaves of noise v and of the squared
    image m²: f² is their weighted regression.
    """
    good = stack.frames.good
    beyond = Beyond(good, highest_frequency_per_px(settings))
    if beyond.share < MIN_SHARE:
        return 0.0
    image = stack.mean_e.reshape(settings.window)
    noise = beyond.power(stack.frames.noise.mean_variance_e2(image, len(stack)))
    square = beyond.power(image**2)
    power = beyond(residual_e.reshape(1, *settings.window))[0] ** 2
    inside, f2, sigma = beyond.inside, 0.0, np.inf
    for _ in range(REGRESSIONS):
        weight = ((noise + f2 * square) ** -2)[inside]
        norm = (weight * square[inside] ** 2).sum()
        f2 = max(0.0, float((weight * (power - noise)[inside] * square[inside]).sum() / norm))
        sigma = float((2 / norm) ** 0.5)
    return float(np.sqrt(f2)) if f2 > SURELY * sigma else 0.0


def highest_frequency_per_px(settings: PsfSettings) -> float:
    """Highest spatial frequency of an image, D/λ of the shortest wavelength [cycles/px]."""
    return cutoff_per_px(settings.shortest_m, settings.geometry.diameter_m, settings.pixel_scale_mas)


class Beyond:
    """Filter for what lies beyond a spatial frequency, in a window that fades out towards its border (Hann).

    Of `good`, (rows, columns), bad pixels are False; they are filled from around them.
    """

    def __init__(self, good: torch.Tensor, frequency_per_px: float):
        self.weight = good.double()
        rows, columns = (torch.fft.fftfreq(size, dtype=torch.float64) for size in good.shape)
        least = frequency_per_px + MAIN_LOBE / min(good.shape)
        self.band = torch.hypot(rows[:, None], columns) > least
        edges = (torch.arange(size, dtype=torch.float64) + 0.5 for size in good.shape)
        hann = (torch.sin(np.pi * one / len(one)) ** 2 for one in edges)
        self.fade = torch.outer(*hann)

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        """The filtered images (images, rows, columns)."""
        filled = (torch.where(self.weight > 0, one, local_mean(one, self.weight)) for one in images)
        return self.of_whole(torch.stack([*filled]))

    def of_whole(self, images: torch.Tensor) -> torch.Tensor:
        """The filtered images (…, rows, columns) that have no bad pixels."""
        return torch.fft.ifft2(torch.fft.fft2(images * self.fade) * self.band).real

    def power(self, variance: torch.Tensor) -> torch.Tensor:
        """Variance of the filtered image of uncorrelated pixels of some `variance`, (rows, columns)."""
        kernel = torch.fft.fft2(torch.fft.ifft2(self.band.double()).abs() ** 2)
        return torch.fft.ifft2(torch.fft.fft2(variance * self.fade**2) * kernel).real.clamp_min(0.0)

    @property
    def share(self) -> float:
        """Part of all frequencies that passes."""
        return float(self.band.double().mean())

    @property
    def inside(self) -> torch.Tensor:
        """Good pixels where the window has not faded."""
        return (self.weight > 0) & (self.fade > FADED)
